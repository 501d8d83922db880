"""A motion as a problem: the same physics, controls and errors as everywhere else."""

import mujoco
import numpy as np
import pytest
import torch
from mujoco import rollout as threads

from flashdex.metrics.criteria_table import Limits
from flashdex.search.config import SearchConfig
from flashdex.search.costs import ErrorLimits, cost, shares
from flashdex.search.problem import FULL

MOTIONS = ["right_box", "left_ball", "both"]


def draw_actions(problem, count=1, seed=0):
    rng = np.random.default_rng(seed)
    shape = (count, problem.steps, len(problem.active), problem.num_joints)
    return problem.spread(rng.uniform(-0.5, 0.5, shape))


@pytest.mark.parametrize("name", MOTIONS)
def test_planning_sees_the_states_of_the_untouched_scene(make_problem, name):
    """Step by step from the state before: what is planned is what will be stored."""
    problem = make_problem(name)
    actions = draw_actions(problem)
    played = problem.play(actions[0])
    model = problem.scene.model
    data = mujoco.MjData(model)
    assert problem.model.nsensordata < model.nsensordata
    trial = problem.simulate(problem.worlds(1), actions)
    data.qpos[:], data.qvel[:] = problem.qpos0, problem.qvel0
    state = np.empty(mujoco.mj_stateSize(model, FULL))
    mujoco.mj_getState(model, data, state, FULL)
    fine = np.repeat(played["ctrl"], 4, axis=0)[None]
    found, _ = threads.rollout(model, data, state[None], fine)
    np.testing.assert_array_equal(trial.states[0, 0], found[0, 3::4])
    adr = problem.adr[0]
    np.testing.assert_array_equal(
        trial.object_pos[0, 0, :, 0], found[0, 3::4, 1 + adr : 4 + adr]
    )


def test_controls_are_those_of_the_environment(make_problem, make_env, action_space):
    """The same actions in the env lead to the same targets, bit for bit."""
    problem = make_problem("both")
    actions = draw_actions(problem)[0]
    env = make_env(1, evaluation=True, **action_space)
    env.forced_motion = torch.tensor([problem.row])
    td = env.reset()
    wanted = problem.controls(actions[None], 0)[0]
    for t in range(10):
        env.put_action(td, torch.from_numpy(actions[t : t + 1]))
        td = env.step(td)["next"]
        np.testing.assert_array_equal(env.physics.raw().ctrl[0].numpy(), wanted[t])


def test_worlds_are_the_same_at_every_call_and_are_not_the_certificates(make_problem):
    problem = make_problem("right_box")
    one, two = problem.worlds(3), problem.worlds(3)
    np.testing.assert_array_equal(one.states, two.states)
    np.testing.assert_array_equal(one.noise, two.noise)
    assert not one.noise[0].any()
    assert (np.abs(one.noise[1:]).max((1, 2)) > 0).all()
    nominal, *others = one.models
    body = nominal.body("object0").id
    for model in others:  # as heavy and slippery as the certificate may draw
        assert model.body_mass[body] == pytest.approx(1.2 * nominal.body_mass[body])
        np.testing.assert_allclose(model.geom_friction, 0.8 * nominal.geom_friction)
    poses = one.states[:, 1 + problem.adr[0] :][:, :7]  # time stands first
    off = poses[1:, :3] - poses[0, :3]
    np.testing.assert_allclose(np.abs(off), 2e-3, atol=1e-12)
    np.testing.assert_allclose(off[0], -off[1], atol=1e-12)
    turn = 2 * np.arccos(np.abs(poses[1:, 3:] @ poses[0, 3:]))
    np.testing.assert_allclose(turn, np.radians(2), atol=1e-6)


def test_fingertips_lie_where_kinematics_says(make_problem, bank, hands):
    from flashdex.geometry.rotation import quat_rotate_inverse
    from flashdex.hands.kinematics import HandKinematics

    problem = make_problem("both")
    rows = torch.full((problem.steps,), problem.row)
    ref = bank.at(rows, torch.arange(problem.steps) + 1)
    tips = HandKinematics(hands)(ref["joint_pos"], None)["tip_pos"]
    off = tips - ref["own_pos"].unsqueeze(2)
    quat = ref["own_quat"].unsqueeze(2).expand(-1, -1, 5, -1)
    own = quat_rotate_inverse(quat, off)
    np.testing.assert_allclose(problem.ref_tips, own.numpy(), atol=2e-5)


@pytest.mark.parametrize("name", MOTIONS)
def test_actions_are_found_again_from_their_controls(make_problem, name):
    """Also those of another space: where they are within reach, the controls agree."""
    problem = make_problem(name)
    actions = draw_actions(problem)
    ctrl = problem.controls(actions, 0)
    found = problem.residuals(ctrl[0])
    np.testing.assert_allclose(problem.controls(found[None], 0), ctrl, atol=1e-6)
    inside = np.abs(found) < 0.99
    inside[:] &= np.abs(found - actions[0]) < 1e-3  # a joint limit cuts some
    assert inside[:, problem.active].mean() > 0.9
    far = problem.residuals(ctrl[0, :7] + 100.0)
    assert (far[:, problem.active] == 1).all()
    assert not far[:, [i for i in range(2) if i not in problem.active]].any()


def test_shares_are_errors_over_limits(make_problem):
    problem = make_problem("right_box")
    trial = problem.simulate(problem.worlds(1), draw_actions(problem))
    trial.object_pos[:] = problem.ref_pos + np.array([0.0, 0.0, 0.015])
    half = np.radians(15.0)
    turn = np.array([np.cos(half / 2), np.sin(half / 2), 0, 0])
    out = np.empty(4)
    for t in range(problem.steps):
        mujoco.mju_mulQuat(out, problem.ref_quat[t, 0], turn)
        trial.object_quat[0, 0, t, 0] = out
    found = shares(
        trial.object_pos, trial.object_quat, problem, 0, ErrorLimits.of("sr_mt_obj")
    )
    np.testing.assert_allclose(found.pos, 0.5, atol=1e-5)
    np.testing.assert_allclose(found.rot, 0.5, atol=1e-5)
    strict = shares(
        trial.object_pos,
        trial.object_quat,
        problem,
        0,
        ErrorLimits.of("sr_mt_obj_x0.5"),
    )
    np.testing.assert_allclose(strict.pos, 1.0, atol=1e-5)
    assert ErrorLimits.of("sr_loose").pos == Limits().loose_pos


def test_a_state_that_is_not_finite_costs_most(make_problem):
    problem, config = make_problem("right_box"), SearchConfig()
    limits = ErrorLimits.of("sr_mt_obj")
    trial = problem.simulate(problem.worlds(1), draw_actions(problem, count=2))
    trial.object_pos[1], trial.object_quat[1] = np.nan, np.nan
    knots = np.zeros((2, 3, 1, problem.num_joints))
    noise = np.ones((1, problem.num_joints))
    costs = cost(trial, knots, noise, problem, config, 0, limits)
    assert np.isfinite(costs.total).all()
    assert costs.total[1] > costs.total[0]
    assert costs.error[1] > 1 > costs.error[0]
