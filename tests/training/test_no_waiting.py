"""A vector step and an update never make the host wait for the device."""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch
from no_sync import forbid_sync
from torch.overrides import TorchFunctionMode

from flashdex import keys
from flashdex.algorithms.config import PPOConfig
from flashdex.envs.mdp.assist import AssistEpoch
from flashdex.envs.mdp.step import StepResult
from flashdex.training.guard import GradientGuard, numeric_errors
from flashdex.training.stats import RunningStats

WORLDS = 6
FACTORIES = {
    getattr(torch, name)
    for name in (
        "tensor",
        "as_tensor",
        "arange",
        "empty",
        "eye",
        "full",
        "linspace",
        "ones",
        "rand",
        "randint",
        "randn",
        "randperm",
        "scalar_tensor",
        "zeros",
    )
}
INDEXED = {torch.Tensor.__getitem__, torch.Tensor.__setitem__}


class OnOneDevice(TorchFunctionMode):
    """Raises where a tensor is made without saying on which device: that is the host.

    Used on a GPU it would be copied there, and such a copy waits. Lists as an index
    become such tensors, too.
    """

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in FACTORIES and kwargs.get("device") is None:
            raise AssertionError(f"{func.__name__} without a device")
        if func in INDEXED:
            parts = args[1] if isinstance(args[1], tuple) else (args[1],)
            assert not any(isinstance(part, list | tuple) for part in parts), args[1]
        return func(*args, **kwargs)


@contextmanager
def device_alone():
    """The host neither waits for the device nor sends it tensors of its own."""
    with forbid_sync(), OnOneDevice():
        yield


def test_the_check_finds_what_it_is_for():
    x = torch.zeros(4)
    with device_alone():
        x[1:3] + torch.ones(2, device=x.device) + x.new_ones(2)
        with pytest.raises(AssertionError):
            x[[0, 1]]
        with pytest.raises(AssertionError):
            torch.eye(3)
        with pytest.raises(AssertionError):
            x[x > 0]


def one_step(env, learner):
    """What a vector step hands to the learner: state, flags and the like."""
    td = env.reset()
    action = learner.act(td)
    for i, side in enumerate(keys.SIDES):
        td.set(keys.action(side), action[:, i])
    td = env.step(td)
    after = td["next"]
    reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
    ends = after[keys.TERMINATED], after[keys.DONE]
    return td, action, reward, after, *ends


@pytest.mark.parametrize("groups", ["per_hand", "unified"])
@pytest.mark.parametrize("replay", ["auto", "cpu"])
def test_flashsac_acts_remembers_and_learns(make_bench, collect, groups, replay):
    sizes = {"groups": groups, "replay": replay, "prefetch": 0, "updates_per_step": 2}
    bench = make_bench(WORLDS, attempt_share=0.5, algo=sizes)
    env = bench.make_env()
    learner = bench.make_learner(env)
    step = one_step(env, learner)
    with device_alone():
        learner.act(step[0])  # before there are rows
        learner.process_step(*step)
    collect(env, learner, 12)
    assert learner.ready
    guard, stats = GradientGuard(waits=False), RunningStats()
    before, dropped = learner.updates, learner.num_dropped
    bad = step[2].clone()
    bad[1] = float("nan")
    with guard:
        learner.update()  # Adam makes its state, TorchRL its caches
        with device_alone():
            for reward in (step[2], bad):
                learner.act(step[0])
                learner.act(step[0], explore=False)
                learner.process_step(step[0], step[1], reward, *step[3:])
                # one of two updates has an actor step
                for _ in range(learner.num_updates()):
                    with numeric_errors(learner):
                        stats.add_update(learner.update())
        guard.check()
    assert learner.updates == before + 1 + 4
    for _ in range(2):
        learner.process_step(*step)  # the window passes the bad reward
    assert learner.num_dropped == dropped + 3  # one in each window it is part of
    found = stats.pop(1.0, WORLDS)
    side = "left" if groups == "per_hand" else "both"
    assert found[f"loss/{side}/loss_qvalue"] > 0
    assert found["loss/learning_rate"] == pytest.approx(3e-4, rel=1e-2)


def test_ppo_acts_and_remembers(make_bench, collect):
    bench = make_bench(
        WORLDS, attempt_share=0.5, algo={"kind": "ppo", "gamma": 0.98, "n_step": 1}
    )
    env = bench.make_env()
    learner = bench.make_learner(env)
    step = one_step(env, learner)
    learner.process_step(*step)
    with device_alone():
        learner.act(step[0])
        learner.process_step(*step)
        assert learner.num_updates() == 0
    assert learner.num_rows == 2 * (WORLDS // 2)


def test_a_gradient_step_of_ppo_does_not_wait(make_bench, collect):
    sizes = {
        "horizon": 4,
        "epochs": 1,
        "minibatches": 2,
        "hidden": [8],
        "target_kl": 10.0,
    }
    bench = make_bench(WORLDS, algo={"kind": "ppo", "ppo": PPOConfig(**sizes)})
    env = bench.make_env()
    learner = bench.make_learner(env)
    for _ in range(2):  # the first rollout sets the input statistics
        collect(env, learner, 4)
        learner.num_updates()
    batches, tail, _ = learner.batches()
    for name, agent in learner.agents.items():
        rows = agent.estimate(batches[name], tail).reshape(-1)
        before = agent.rate.clone()
        with device_alone():
            agent._step(rows, True)
            agent._step(rows, False)
        assert agent.rate > before  # it was steered


def outcome_of(seed):
    generator = torch.Generator().manual_seed(seed)

    def draw(chance=0.5):
        return torch.rand(WORLDS, 2, generator=generator) < chance

    values = torch.rand(4, WORLDS, 2, generator=generator)
    terms = {"object_points": values[0], "wrist_pos": values[1]}
    active, causes = draw(0.8), {"object": draw(), "wrist": draw()}
    blame = causes["object"] | causes["wrist"]
    errors, rows = (values[3], values[3]), torch.zeros(WORLDS)
    return StepResult(values[2], terms, blame, causes, *errors, active, rows, rows)


def test_statistics_are_those_of_loops_over_worlds_and_hands():
    stats, epoch = (
        RunningStats(),
        AssistEpoch({"object_points": "task", "wrist_pos": "imitation"}),
    )
    steps = []
    for seed in range(3):
        outcome = outcome_of(seed)
        outcome.reward_terms["wrist_pos"][seed, 1] = float("nan")  # counts as 0
        failed = outcome.failed.any(-1, keepdim=True)
        done = failed | (torch.arange(WORLDS) == seed)[:, None]
        assisted = torch.arange(WORLDS) > 1
        steps.append((outcome, done, failed))
        with device_alone():
            stats.add_step(outcome, done, failed)
            epoch.add(outcome, assisted, done, failed)
    found = stats.pop(2.0, WORLDS)
    right = [
        0.0 if (value := o.reward_terms["wrist_pos"][n, 1].item()) != value else value
        for o, _, _ in steps
        for n in range(WORLDS)
        if o.active[n, 1]
    ]
    assert found["reward/right/wrist_pos"] == pytest.approx(sum(right) / len(right))
    ended = sum(int(d[n]) for _, d, _ in steps for n in range(WORLDS))
    failed = sum(int(f[n]) for _, _, f in steps for n in range(WORLDS))
    wrist = sum(
        int(o.terminations["wrist"][n].any()) for o, _, _ in steps for n in range(6)
    )
    assert found["episode/ends"] == ended
    assert found["episode/completed"] == pytest.approx((ended - failed) / ended)
    assert found["episode/wrist"] == pytest.approx(wrist / ended)
    assert found["perf/env_steps_per_s"] == 9
    assert stats.pop(1.0, WORLDS)["episode/ends"] == 0
    check_epoch(epoch, steps)


def check_epoch(epoch, steps):
    again = AssistEpoch({"object_points": "task", "wrist_pos": "imitation"})
    again.load_state_dict(epoch.state_dict())
    points = [
        o.reward_terms["object_points"][n, h].item()
        for o, _, _ in steps
        for n in range(2, WORLDS)
        for h in range(2)
        if o.active[n, h]
    ]
    ended = sum(int(d[2:].sum()) for _, d, _ in steps)
    failed = sum(int(f[2:].sum()) for _, _, f in steps)
    found = again.pop()
    assert found["task"] == pytest.approx(sum(points) / len(points))
    assert found["completion"] == pytest.approx(1 - failed / ended)
    assert epoch.pop() == found
    # an open epoch of a run that has other rewards now begins anew
    again.load_state_dict({"sums": {"x": 1.0}, "count": 2.0, "ended": 1, "failed": 1})
    again.add(steps[0][0], torch.ones(WORLDS).bool(), steps[0][1] & False, steps[0][2])
    assert again.state_dict()["count"] == int(steps[0][0].active.sum())
