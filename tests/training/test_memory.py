"""The memory plan against what is really allocated, and its verdicts."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import nn

from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.footprint import PeakMeter, tensor_bytes
from flashdex.cli.memory_report import format_cards, format_plan
from flashdex.envs.config import EnvConfig
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.errors import FlashdexError
from flashdex.recipe import Recipe
from flashdex.system.machine import Machine
from flashdex.training.memory import plan as memory
from flashdex.training.memory.plan import (
    GPU_ALLOWANCE,
    MemoryPlan,
    check_memory,
    format_size,
    list_parts,
    overrides_that_fit,
    plan_memory,
    round_down,
)
from flashdex.training.memory.stand_in import Collection

GB = 10**9
ROOMY = Machine(gpu=None, host=100 * GB, disk=100 * GB)


@pytest.fixture
def trained(make_bench, collect):
    """A tiny builder, its learner after updates, and their plan."""

    def make(**options):
        bench = make_bench(6, **options)
        env = bench.make_env()
        learner = bench.make_learner(env)
        collect(env, learner, 20)
        for _ in range(3):
            learner.update()
        plan = plan_memory(bench.recipe, library=bench.library, machine=ROOMY)
        return env, learner, plan

    return make


@pytest.fixture(scope="module")
def plan(library):
    """Plan of a tiny recipe, without making any of it."""
    small = {"object_points": {"num_points": 8}}
    recipe = Recipe(
        name="tiny",
        total_env_steps=6000,
        env=EnvConfig(num_envs=6, transforms={**EnvConfig().transforms, **small}),
        algo=AlgoConfig(
            batch_size=32,
            buffer_size=400,
            min_buffer=40,
            actor_width=16,
            critic_width=16,
        ),
        physics=PhysicsConfig(num_threads=1),
    )
    return plan_memory(recipe, library=library, machine=ROOMY)


def part(plan: MemoryPlan, name: str):
    return next(p for p in plan.parts if p.name == name)


def stored_bytes(learner):
    return sum(v.numel() * v.element_size() for v in leaves(learner))


def leaves(learner):
    return list(learner.buffer.storage._storage.values(True, True))


@pytest.mark.parametrize("rows", [400, 433])
def test_replay_rows_are_exact(trained, rows):
    _, learner, plan = trained(algo={"buffer_size": rows})
    assert part(plan, "replay rows").size == stored_bytes(learner)
    assert all(len(leaf) == rows for leaf in leaves(learner))


@pytest.mark.parametrize(
    "algo",
    [{}, {"groups": "unified"}, {"norm_warmup": True, "critic_blocks": 1}],
    ids=["per_hand", "unified", "norm_warmup"],
)
def test_networks_are_exact(trained, algo):
    _, learner, plan = trained(algo=algo)
    nets, stepper = plan.sizes.learner.networks, learner.agent.stepper
    loss = learner.agent.loss
    everything = [p for _, p in nn.Module.named_parameters(loss)]
    own = [
        b
        for name, b in loss.named_buffers()
        if not name.startswith("reward_normalizer")
    ]
    assert nets.weights == tensor_bytes([everything, own])
    optimizers = (
        stepper.actor_optimizer,
        stepper.critic_optimizer,
        stepper.alpha_optimizer,
    )
    state = [o.adam.state for o in optimizers]
    assert nets.moments == sum(tensor_bytes(dict(s)) for s in state)
    assert nets.gradients == sum(
        tensor_bytes(o.adam.param_groups[0]["params"]) for o in optimizers
    )
    assert part(plan, "networks").size == nets.total


def test_the_bank_is_exact(trained):
    env, _, plan = trained()
    planned = part(plan, "reference frames").size + part(plan, "objects").size
    assert planned == tensor_bytes(list(env.bank.buffers()))


def test_the_rings_of_attempts_are_exact(trained):
    from flashdex.rollouts.recorder import EpisodeRecorder

    env, _, plan = trained(attempt_share=0.5)
    recorder = EpisodeRecorder(env)
    recorder.record_start()
    action = torch.zeros(6, 2, env.bank.num_joints)
    recorder.record_step(action, torch.zeros(6, 1, dtype=torch.bool), 0)
    assert part(plan, "attempts").size == tensor_bytes(recorder._rings)


def test_the_window_of_n_steps_is_exact(trained):
    _, learner, plan = trained(algo={"n_step": 4})
    steps = learner.nstep.state_dict()["steps"]
    assert part(plan, "n-step window").size == tensor_bytes(steps)


LEARNER = (*("replay rows", "networks", "update", "observations"), "rollout")


@pytest.mark.parametrize("kind", ["flashsac", "ppo"])
def test_the_learner_takes_no_more_than_planned(make_bench, collect, kind):
    wide = {"actor_width": 64, "critic_width": 128, "buffer_size": 2000}
    bench = make_bench(16, algo={"kind": kind, "batch_size": 256, **wide})
    plan = plan_memory(bench.recipe, library=bench.library, machine=ROOMY)
    env = bench.make_env()
    with PeakMeter() as meter:
        learner = bench.make_learner(env)
        for _ in range(3):  # Adam's moments are there from the second update on
            collect(env, learner, 24)
            for _ in range(learner.num_updates()):
                learner.update()
    assert learner.updates >= 2
    planned = sum(p.size for p in plan.parts if p.name in LEARNER)
    # samples are assembled before the update, so that both peaks are not there at once
    assert meter.peak <= planned <= 1.3 * meter.peak


@pytest.mark.gpu
def test_a_gpu_takes_no_more_than_planned(make_bench, collect):
    wide = {"actor_width": 128, "critic_width": 512, "buffer_size": 100_000}
    options = {"device": "cuda", "batch_size": 4096, "compile": False, **wide}
    bench = make_bench(64, algo=options)
    plan = plan_memory(bench.recipe, library=bench.library, machine=ROOMY, device="gpu")
    env = bench.make_env()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    learner = bench.make_learner(env)
    collect(env, learner, 24)
    for _ in range(2):
        learner.update()
    planned = sum(p.size for p in plan.parts if p.name in LEARNER)
    peak = torch.cuda.max_memory_allocated() - before
    assert 0.7 * planned < peak < 1.1 * planned


def test_the_cpu_engine_is_exact(trained):
    env, _, plan = trained()
    batch = env.physics.batch
    derived = (batch.bind("sensordata"), batch.warning)
    world = batch.nstate * 8 + sum(v.nbytes for v in derived) // 6
    assert plan.sizes.cpu[0] == world


def test_unprepared_motions_are_the_worst_case(plan, tmp_path):
    motions = dataclasses.replace(plan.recipe.motions, library=str(tmp_path), count=3)
    recipe = dataclasses.replace(plan.recipe, motions=motions)
    worst = plan_memory(recipe, machine=ROOMY)
    assert not worst.sizes.collection.known
    assert part(worst, "reference frames").size > part(plan, "reference frames").size
    assert worst.sizes.row_bytes >= plan.sizes.row_bytes
    assert "not prepared yet: 3 motions" in format_plan(worst)
    # a guess alone refuses nothing
    assumed = worst.need("host") - worst.need("host", certain=True)
    assert assumed >= part(worst, "reference frames").size
    short = Machine(None, host=worst.need("host") - 1, disk=GB)
    assert worst.on(short).fits
    assert worst.on(short).tight == ["host"]


def test_sizes_of_a_library(library):
    sizes = Collection.of(library)
    assert (sizes.motions, sizes.frames, sizes.longest) == (3, 123, 52)
    assert (sizes.objects, sizes.layout.sides) == (2, ("left", "right"))
    assert sizes.layout.num_parts == (1, 1)


def test_more_than_there_is_does_not_fit(plan):
    plan = plan.change(algo__buffer_size=30_000_000, algo__replay="device")
    row = plan.sizes.row_bytes
    rest = plan.need("host") - 30_000_000 * row
    exact = Machine(None, host=plan.need("host"), disk=GB)
    assert plan.on(exact).fits
    assert plan.on(exact).tight == ["host"]
    small = dataclasses.replace(exact, host=plan.need("host") - 1)
    assert plan.on(small).short == ["host"]
    largest = plan.on(small).largest_buffer
    assert largest == round_down((int(0.9 * small.host) - rest) // row)
    assert overrides_that_fit(plan.on(small))[0] == f"algo.buffer_size={largest}"
    assert plan.on(small).change(algo__buffer_size=largest).fits


def on_gpu(plan, free, **values):
    moved = plan.change(**values)
    parts = list_parts(moved.recipe, plan.sizes, device="gpu")
    machine = Machine(free, 100 * GB, 100 * GB, "card")
    return dataclasses.replace(moved, device="gpu", parts=parts, machine=machine)


def test_rows_move_to_pinned_memory(plan):
    large = on_gpu(plan, 8 * GB, algo__buffer_size=50_000_000)
    assert large.short == ["gpu"]
    assert "algo.replay=pinned" in overrides_that_fit(large)
    pinned = large.change(algo__replay="pinned")
    moved = large.need("gpu") - pinned.need("gpu")
    assert moved == 50_000_000 * plan.sizes.row_bytes
    assert pinned.need("host") == large.need("host") + moved
    assert pinned.largest_buffer > large.largest_buffer > 0
    both = dataclasses.replace(large.machine, host=20 * GB)
    found = overrides_that_fit(large.on(both))
    rows = pinned.on(both).largest_buffer
    assert f"algo.replay=pinned algo.buffer_size={rows}" in found


@pytest.mark.parametrize(
    ("key", "value"), [("env.num_envs", 16384), ("algo.batch_size", 16384)]
)
def test_fewer_worlds_or_a_smaller_batch(plan, key, value):
    name = key.replace(".", "__")
    large = plan.change(**{name: value})
    between = (plan.need("host") + large.need("host")) // 2
    found = overrides_that_fit(large.on(Machine(None, between, GB)))
    (words,) = [w for w in found if w.startswith(key)]
    smaller = int(words.split("=")[1])
    fitting = large.on(Machine(None, between, GB)).change(**{name: smaller})
    assert fitting.fits
    assert not fitting.change(**{name: 2 * smaller}).fits


def test_several_changes_where_one_is_not_enough(plan):
    large = plan.change(env__num_envs=8192, algo__batch_size=8192)
    single = min(
        large.change(env__num_envs=2).need("host"),
        large.change(algo__batch_size=2).need("host"),
    )
    machine = Machine(None, (plan.need("host") + single) // 2, GB)
    (words,) = overrides_that_fit(large.on(machine))
    values = dict(word.split("=") for word in words.split())
    changes = {k.replace(".", "__"): int(v) for k, v in values.items()}
    assert large.on(machine).change(**changes).fits


def test_stored_rows_need_disk(plan):
    plan = plan.change(train__checkpoint_replay=True)
    row = plan.sizes.row_bytes
    assert part(plan, "stored replay rows").size == 400 * row
    full = plan.on(Machine(None, 100 * GB, disk=plan.need("disk") - 1))
    assert overrides_that_fit(full)[0] == "train.checkpoint_replay=false"


def test_a_run_that_cannot_fit_is_refused(plan, library, monkeypatch, caplog):
    recipe = plan.change(algo__buffer_size=10**8).recipe
    need = plan.change(algo__buffer_size=10**8).need("host")

    def check(host):
        found = Machine(None, host=host, disk=100 * GB)
        monkeypatch.setattr(memory, "look_at_machine", lambda _: found)
        return check_memory(recipe, library=library)

    with pytest.raises(FlashdexError, match="too little memory") as caught:
        check(need - 1)
    assert format_size(need) in str(caught.value)
    assert "\n  algo.buffer_size=" in str(caught.value)
    line = check(2 * need)
    assert line.startswith(f"memory: host memory {format_size(need)} of ")
    assert "\n" not in line
    assert not caplog.records
    check(need + 1)
    assert "memory is tight: host memory" in caplog.text


def test_cards_hold_what_fits(plan):
    large = on_gpu(plan, None, algo__buffer_size=50_000_000)
    lines = format_cards(large).splitlines()[1:]
    assert [line.split()[0] for line in lines] == ["24", "48", "80", "141"]
    assert "all 50,000,000 rows" in lines[3]
    rest = large.need("gpu") - 50_000_000 * large.sizes.row_bytes
    assert rest > GPU_ALLOWANCE
    usable = int(0.9 * int(24e9 * 0.97)) - rest
    rows = round_down(usable // large.sizes.row_bytes)
    assert f"{rows:,} rows" in lines[0]


@pytest.mark.parametrize(
    ("number", "expected"),
    [(-5, 0), (7, 7), (99, 99), (12345, 12000), (48999999, 48000000)],
)
def test_round_down(number, expected):
    assert round_down(number) == expected


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        (999, "999 B"),
        (1500, "1.5 kB"),
        (49_500_000_000, "49.5 GB"),
        (110 * GB, "110 GB"),
    ],
)
def test_format_size(size, expected):
    assert format_size(size) == expected
