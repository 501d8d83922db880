"""One suite for all engines: the same scenarios, each against MuJoCo C.

What runs is in ``conformance_script.py``, what is measured in
``conformance_measures.py``, what is allowed and why in ``conformance_limits.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import mujoco
import numpy as np
import pytest
import torch
from conformance_limits import ENGINES, LIMITS, RESET_LIMITS, STEPS_OF, Column, Engine
from conformance_measures import MEASURES
from conformance_mutations import FINE_MUTATIONS, MUTATIONS
from conformance_oracle import (
    Oracle,
    Record,
    on_device,
    read_engine,
    run_engine,
    step_like_mjx,
)
from conformance_script import NUM_WORLDS, RIGHT, ROW, Script, make_script
from engine_states import raw_state, reset_worlds
from reduced import reduced_library
from synthetic import FRIENDLY

from flashdex.envs.physics.base import Physics
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.make import make_physics as build_engine
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.scene import Scene, build_scenes

ABSOLUTE = ("fall.formula", "spin.momentum", "grip.weight", "cradle.weight")
BROKEN = MUTATIONS | FINE_MUTATIONS
TABLE = LIMITS | RESET_LIMITS
PACKAGES = {"cpu": (), "warp": ("warp", "mujoco_warp"), "brax": ("jax", "brax")}


@dataclass(frozen=True)
class Run:
    """An engine after it has played the script, and what it did."""

    name: str
    physics: Physics
    record: Record
    last: dict[str, np.ndarray]  # raw state at the end


@pytest.fixture(scope="module")
def small(tmp_path_factory, hands):
    """Library, reference and script of one hand and one box."""
    library = reduced_library(tmp_path_factory.mktemp("conformance") / "l", hands)
    return library, partial(make_script, library, ReferenceBank(library, hands), hands)


@pytest.fixture(scope="module")
def script(small) -> Script:
    return small[1]()


@pytest.fixture(scope="module")
def scene(small, hands) -> Scene:
    return build_scenes(small[0], hands, PhysicsConfig(**FRIENDLY))[0]


@pytest.fixture(scope="module")
def oracle(scene) -> Oracle:
    return Oracle(scene)


@pytest.fixture(scope="module")
def truth(oracle, script) -> Record:
    return oracle.run(script)


@pytest.fixture(scope="module")
def own_truth(scene, script) -> Record:
    """MuJoCo C with MJX's integration."""
    return Oracle(scene, step=step_like_mjx).run(script, steps=STEPS_OF["brax"])


@pytest.fixture(scope="module")
def play(small, script, hands) -> Callable[[Engine], Run]:
    """Each engine is compiled and run once for all tests."""

    @cache
    def run_once(name: Engine) -> Run:
        for package in PACKAGES[name]:
            pytest.importorskip(package)
        config = PhysicsConfig(engine=name, num_threads=1, **FRIENDLY)
        physics = build_engine(small[0], hands, config, NUM_WORLDS)
        record = run_engine(physics, script, STEPS_OF[name])
        raw = vars(physics.raw())
        last = {k: x.double().cpu().numpy().copy() for k, x in raw.items()}
        return Run(name, physics, record, last)

    return run_once


@pytest.fixture(params=ENGINES)
def run(request, play) -> Run:
    return play(request.param)


def over_limit(
    column: Column, found: dict[str, float]
) -> dict[str, tuple[float, float]]:
    """Measured numbers beyond their limits, with the limits."""
    allowed = {name: getattr(TABLE[name], column) for name in found}
    # Written so that a number that is not finite is over it.
    return {n: (x, allowed[n]) for n, x in found.items() if not x <= allowed[n]}


@pytest.mark.parametrize("scenario", MEASURES)
def test_engine_stays_near_mujoco_c(run, truth, scenario):
    steps = len(run.record.joint_pos)
    found = MEASURES[scenario][0](run.record, truth.until(steps))
    assert over_limit(run.name, found) == {}


@pytest.mark.parametrize("scenario", MEASURES)
def test_brax_differs_by_integration_and_contact_only(play, own_truth, scenario):
    found = MEASURES[scenario][0](play("brax").record, own_truth)
    assert over_limit("brax_own", found) == {}


@pytest.fixture(scope="module")
def break_it(scene, script) -> Callable[[str, bool], Record]:
    """Run an edited oracle; engines that integrate alike share its record."""

    @cache
    def run_once(name: str, like_mjx: bool) -> Record:
        scenario, edit = BROKEN[name]
        step = step_like_mjx if like_mjx else mujoco.mj_step
        # Gains show in the first two steps of the targets.
        steps = 60 if scenario == "small_steps" else STEPS_OF["brax"]
        return Oracle(scene, edit, step).run(script, MEASURES[scenario][1], steps)

    return run_once


CASES = [(e, m) for e in ENGINES for m in BROKEN if e != "brax" or m in MUTATIONS]


@pytest.mark.parametrize(("engine", "mutation"), CASES)
def test_limits_tell_a_broken_engine(play, break_it, engine, mutation):
    column = "brax_own" if engine == "brax" else engine
    wrong = break_it(mutation, engine == "brax")
    record = play(engine).record.until(len(wrong.joint_pos))
    found = MEASURES[BROKEN[mutation][0]][0](record, wrong)
    # What needs no oracle says nothing of the edit.
    found = {n: x for n, x in found.items() if n not in ABSOLUTE}
    assert over_limit(column, found)


def test_every_number_has_a_limit_and_a_reason(truth):
    found = [name for f, _ in MEASURES.values() for name in f(truth, truth)]
    assert sorted(found) == sorted(LIMITS)
    assert all(len(limit.why) > 20 for limit in TABLE.values())


def test_the_script_does_what_it_says(truth):
    """The grip lifts, the hand carries, joints reach their ends, friction stops."""
    pose, force = truth.object_pose, truth.contact[..., :3]
    assert pose[60:120, ROW["grip"], 2].min() > 0.09
    assert (np.abs(force[60:120, ROW["grip"], 3]).max(-1) > 0.1).all()  # thumb tip
    assert pose[60:120, ROW["cradle"], 2].min() > 0.5
    ends = truth.joint_pos[-1, ROW["lower"], 6:]
    assert np.abs(ends - truth.joint_pos[-2, ROW["lower"], 6:]).max() < 1e-3
    assert np.ptp(truth.joint_pos[:, ROW["large_steps"]], 0)[6:].min() > 0.1
    assert np.abs(truth.object_vel[-1, ROW["twirl"]]).max() < 1e-3
    touched = (np.abs(force).max(-1) > 0).any(-1)
    assert touched[:, [ROW[f"random{i}"] for i in range(4)]].mean() > 0.5


def test_raw_state_is_the_state_in_mujocos_layout(run, oracle):
    last = run.record
    for row in range(NUM_WORLDS):
        data = mujoco.MjData(oracle.model)
        data.qpos[:], data.qvel[:] = run.last["qpos"][row], run.last["qvel"][row]
        found = oracle.read(data)[:4]
        for name, value in zip(list(vars(last))[:4], found, strict=True):
            wanted = getattr(last, name)[-1, row]
            np.testing.assert_allclose(value, wanted, rtol=2e-6, atol=2e-6)


def test_equal_worlds_are_equal_bit_for_bit(run):
    for field in vars(run.record).values():
        assert (field[:, ROW["twin"]] == field[:, ROW["random0"]]).all()


def test_nothing_overflowed_and_no_number_broke(run):
    assert run.physics.take_overflow() == {}
    assert not run.physics.state()["bad"].any()


RESET = {"grip": 3, "cradle": 8, "random1": 0}  # state of this scenario into a world


def middle_states(truth: Record, step: int = 90) -> dict[str, torch.Tensor]:
    """States of the oracle in mid motion, a row of ``RESET`` each."""
    rows = [ROW[name] for name in RESET]
    n, joints = len(rows), truth.joint_pos.shape[-1]
    out = {
        "joint_pos": torch.zeros(n, 2, joints),
        "joint_vel": torch.zeros(n, 2, joints),
        "object_pose": torch.zeros(n, 2, 7),
        "object_vel": torch.zeros(n, 2, 6),
    }
    out["object_pose"][:, 1, 3] = 1.0  # the empty slot
    for name, value in out.items():
        slot = RIGHT if name.startswith("joint") else 0
        value[:, slot] = torch.as_tensor(getattr(truth, name)[step, rows])
    return out


def test_reset_in_mid_motion(run, oracle, truth):
    """State as written, contact as ``mj_forward`` has it, other worlds untouched."""
    physics, states = run.physics, middle_states(truth)
    ids = torch.tensor(list(RESET.values()))
    before = [raw_state(physics, env) for env in range(NUM_WORLDS)]
    sensed = read_engine(physics)[-1]
    reset_worlds(physics, ids, torch.zeros_like(ids), states)
    found = read_engine(physics)
    gap = {"state": 0.0, "spin": 0.0, "force": 0.0, "point": 0.0}
    for row, env in enumerate(ids.tolist()):
        wanted = oracle.read(oracle.start(states, row))
        here = [np.abs(f[env] - w) for f, w in zip(found, wanted, strict=True)]
        gap["state"] = max(gap["state"], *(x.max() for x in here[:3]))
        gap["spin"] = max(gap["spin"], here[3].max())
        gap["force"] = max(gap["force"], here[4][:, :3].max())
        gap["point"] = max(gap["point"], here[4][:, 3:].max())
        assert np.abs(wanted[4][:, :3]).max() > 0.1
    assert over_limit(run.name, {f"reset.{k}": float(x) for k, x in gap.items()}) == {}
    for env in set(range(NUM_WORLDS)) - set(ids.tolist()):
        for old, new in zip(before[env], raw_state(physics, env), strict=True):
            assert (old == new).all()
        assert (sensed[env] == found[-1][env]).all()


def test_no_wrench_is_a_zero_wrench(run, script):
    """The step without a wrench, and one that pulls no world, give the same numbers."""
    ends = []
    for pulled in (False, True):
        physics, device = run.physics, run.physics.device
        state = {name: x.to(device) for name, x in script.state.items()}
        motion = torch.zeros(NUM_WORLDS, dtype=torch.long, device=device)
        physics.reset(torch.ones_like(motion).bool(), motion, **state)
        wrench = on_device(script.wrench(0), device)
        wrench.present[:] = False
        for step in range(3):
            target = script.target[step].to(device)
            physics.step(target, wrench if pulled else None)
        ends.append(read_engine(physics))
    for one, other in zip(*ends, strict=True):
        assert (one == other).all()
    played = run.record.joint_pos[2, ROW["grip"]]
    assert (ends[0][0][ROW["grip"]] == played).all()
    assert physics.raw().wrench.abs().max() == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_other_seeds_stay_within_the_same_limits(run, small, oracle, seed):
    script, steps = small[1](seed), STEPS_OF[run.name]
    truth = oracle.run(script, steps=steps)
    record = run_engine(run.physics, script, steps)
    found: dict[str, float] = {}
    for measure, _ in MEASURES.values():
        found |= measure(record, truth)
    assert over_limit(run.name, found) == {}
