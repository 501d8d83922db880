"""Samples in MuJoCo Warp, on the CPU: where MuJoCo C says that the worlds go."""

import dataclasses
import gc
import weakref

import mujoco
import numpy as np
import pytest

from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.warp.rollout import WarpRollout
from flashdex.envs.scene.perturbation import perturb_model
from flashdex.errors import FlashdexError
from flashdex.search.config import Rung, SearchConfig
from flashdex.search.simulate import BATCHES, Warp, Worlds

pytest.importorskip("mujoco_warp")
STEPS = 8


@pytest.fixture(scope="module")
def warp():
    return Warp(PhysicsConfig())


def draw_controls(problem, count=4):
    rng = np.random.default_rng(0)
    shape = (count, STEPS, len(problem.active), problem.num_joints)
    return problem.controls(problem.spread(rng.uniform(-0.5, 0.5, shape)), 0)


def only(batches):
    """The one there is."""
    (batch,) = batches.values()
    return batch


def both(warp, problem, worlds, ctrl, first=0):
    """States and sensors of either engine."""
    return warp(worlds, ctrl, first), problem._truth(worlds, ctrl, first)


@pytest.mark.parametrize("name", ["right_box", "left_ball"])
def test_worlds_go_where_mujoco_c_says(make_problem, warp, name):
    """Within float32, until a contact that is there or not; see docs/engines.md."""
    problem = make_problem(name)
    worlds = problem.worlds(3)
    got, wanted = both(warp, problem, worlds, draw_controls(problem), first=2)
    for a, b in zip(got, wanted, strict=True):
        assert a.shape == b.shape
    error = np.abs(got[0] - wanted[0])
    np.testing.assert_allclose(error[..., 0], 0, atol=1e-7)  # time
    qpos = error[..., 1 : 1 + problem.model.nq].max(-1)
    for k, median in enumerate((5e-5, 1e-3, 1e-3)):  # contacts begin at corners
        assert np.median(qpos[:, k]) < median  # m, rad
    assert qpos.max() < 0.05
    tips = np.abs(got[1] - wanted[1])
    assert np.median(tips.max(-1)) < 1e-4  # m
    assert tips.max() < 0.01


def test_masses_and_friction_are_those_of_each_world(make_problem, warp):
    """From one state, under the same controls: what differs is the models."""
    problem = make_problem("right_box")
    worlds = problem.worlds(3)
    random = np.random.default_rng(5)
    models = [*worlds.models[:2], perturb_model(problem.model, problem._bodies, random)]
    alike = Worlds(
        models, np.tile(worlds.states[:1], (3, 1)), np.zeros_like(worlds.noise)
    )
    (got, _), (wanted, _) = both(warp, problem, alike, draw_controls(problem))
    columns = 1 + problem.adr[0] + np.arange(3)
    got, wanted = got[..., -1, columns], wanted[..., -1, columns]
    own = np.abs(got - wanted).max(-1)
    for k in range(3):
        for other in {0, 1, 2} - {k}:
            between = np.abs(wanted[:, k] - wanted[:, other]).max(-1)
            assert np.median(own[:, k]) < 0.2 * np.median(between), (k, other)


def test_a_recorded_step_gives_what_a_launched_one_gives(make_problem):
    """And the worlds keep nothing of the rollout before."""
    problem, warp = make_problem("right_box"), Warp(PhysicsConfig())
    worlds, ctrl = problem.worlds(2), draw_controls(problem, count=2)
    first = warp(worlds, ctrl, 0)
    warp(worlds, ctrl[::-1].copy(), 0)
    again = warp(worlds, ctrl, 0)
    assert only(warp._batches)._step._graph is not None
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_worlds_are_gone_when_many_others_are_asked_for(make_problem):
    """At once, not when the collector comes by: a device has no room for all."""
    problem, warp = make_problem("right_box"), Warp(PhysicsConfig())
    worlds, ctrl = problem.worlds(1), draw_controls(problem, count=BATCHES + 1)[:, :1]
    warp(worlds, ctrl, 0)
    before = weakref.ref(only(warp._batches))
    gc.disable()
    try:
        for count in range(BATCHES, 0, -1):
            assert before() is not None
            warp(worlds, ctrl[:count], 0)
    finally:
        gc.enable()
    assert before() is None


def test_one_sequence_is_carried_out_in_mujoco_c(make_problem):
    """Whatever tries the samples: plans stand on the states that are judged."""

    def refuse(*_):
        raise AssertionError("asked")

    problem = make_problem("right_box")
    problem._simulator = refuse
    one = problem.spread(np.zeros((1, 4, 1, problem.num_joints)))
    problem.simulate(problem.worlds(2), one)
    with pytest.raises(AssertionError, match="asked"):
        problem.simulate(problem.worlds(2), np.repeat(one, 2, 0))


def test_worlds_that_warp_cannot_tell_apart_are_refused(make_problem, warp):
    problem = make_problem("right_box")
    worlds = problem.worlds(2)
    worlds.models[1].geom_condim[:] = 3
    with pytest.raises(FlashdexError, match="geom_condim"):
        warp(worlds, draw_controls(problem), 0)


def test_room_that_runs_out_is_said_once(make_problem, caplog):
    problem = make_problem("right_box")
    warp = Warp(PhysicsConfig(nconmax=1, njmax=30))
    worlds, ctrl = problem.worlds(1), draw_controls(problem)
    for _ in range(2):
        warp(worlds, ctrl, 0)
    assert warp.overflow
    (told,) = [r.getMessage() for r in caplog.records if "ran out" in r.getMessage()]
    assert "physics.nconmax" in told


def test_samples_that_do_not_fit_are_played_in_turn(make_problem, warp, monkeypatch):
    problem = make_problem("right_box")
    worlds, ctrl = problem.worlds(2), draw_controls(problem, count=5)[:, :2]
    wanted = warp(worlds, ctrl, 0)
    put = WarpRollout._put

    def scarce(self, physics):
        if self.count * len(self.models) > 4:
            raise RuntimeError("Failed to allocate")
        return put(self, physics)

    monkeypatch.setattr(WarpRollout, "_put", scarce)
    few = Warp(PhysicsConfig())
    for a, b in zip(few(worlds, ctrl, 0), wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4, rtol=1e-4)
    assert only(few._batches).count == 2
    monkeypatch.setattr(WarpRollout, "_put", nothing_fits)
    with pytest.raises(FlashdexError, match="do not fit"):
        Warp(PhysicsConfig())(worlds, ctrl, 0)


def nothing_fits(*_):
    raise RuntimeError("Failed to allocate")


def test_a_gpu_gets_more_samples():
    config = SearchConfig(ladder=[Rung(samples=16)], robust_ladder=[Rung(samples=8)])
    on_gpu = dataclasses.replace(config, engine="warp")
    assert [r.samples for r in config.rungs] == [16, 8]
    assert [r.samples for r in on_gpu.rungs] == [1024, 512]
    few = dataclasses.replace(on_gpu, samples_factor=2)
    assert [r.samples for r in few.rungs] == [32, 16]


def test_the_models_of_a_problem_stay_as_they_are(make_problem, warp):
    """Warp wants another flag: MuJoCo C goes on without it."""
    problem = make_problem("right_box")
    worlds = problem.worlds(1)
    before = problem.model.opt.disableflags
    assert before & int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    warp(worlds, draw_controls(problem), 0)
    assert problem.model.opt.disableflags == before
