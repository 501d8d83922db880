"""A pass: the same by its seed, playback without noise, given up when it is lost."""

import dataclasses

import numpy as np
import pytest

from flashdex.hands.kinematics import HandKinematics
from flashdex.search.config import Rung, SearchConfig
from flashdex.search.costs import ErrorLimits, shares
from flashdex.search.plan import Planner, closing_directions

LIMITS = ErrorLimits.of("sr_mt_obj")
CHEAP = Rung(samples=4, rounds=1, horizon=8)


def plan(problem, rung=CHEAP, seed=(0,), grace=15, limits=LIMITS, start=None, **fields):
    config = dataclasses.replace(SearchConfig(), **fields)
    given = {"limits": limits, "grace": grace, "seed": list(seed), "start": start}
    return Planner(problem, config, rung, **given).run()


def test_a_plan_follows_from_its_seed(make_problem):
    problem = make_problem("right_box")
    one, two, other = (plan(problem, seed=s) for s in ((1,), (1,), (2,)))
    np.testing.assert_array_equal(one.actions, two.actions)
    assert not np.array_equal(one.actions, other.actions)
    assert np.abs(one.actions).max() <= 1
    assert not one.actions[:, 0].any()  # the hand that takes no part


def test_without_noise_a_plan_is_playback(make_problem):
    fields = ("wrist_pos_noise", "wrist_rot_noise", "finger_noise", "squeeze_noise")
    found = plan(make_problem("right_box"), **dict.fromkeys(fields, 0.0))
    assert not found.actions.any()


def test_without_noise_a_plan_is_where_it_starts(make_problem):
    """Actions that are linear between knots come back; behind them is playback."""
    problem = make_problem("right_box")
    fields = ("wrist_pos_noise", "wrist_rot_noise", "finger_noise", "squeeze_noise")
    still = dict.fromkeys(fields, 0.0)
    ramp = np.linspace(0, 0.08, 9)[:, None, None].repeat(problem.num_joints, 2)
    start = problem.spread(ramp)
    found = plan(problem, start=start, **still)
    np.testing.assert_allclose(found.actions[:9], start, atol=1e-6)
    assert not found.actions[12:].any()
    noise = np.random.default_rng(0).normal(size=start.shape).astype(np.float32)
    assert np.abs(plan(problem, start=start + noise, **still).actions).max() <= 1


def test_a_pass_beyond_its_limits_is_given_up(make_problem):
    problem = make_problem("right_box")
    impossible = ErrorLimits(1e-9, 1e-9)
    found = plan(problem, grace=0, limits=impossible)
    assert not found.is_whole
    assert len(found.actions) < problem.steps


def test_a_pass_goes_back_where_it_loses_an_object(make_problem):
    """Under limits by which the same noise gives up, tries more, and comes through."""
    problem, strict = make_problem("right_box"), ErrorLimits(0.006, 0.12)
    once = plan(problem, CHEAP, (3,), grace=0, limits=strict)
    before = problem.simulated
    again = dataclasses.replace(CHEAP, retries=6)
    found = plan(problem, again, (3,), grace=0, limits=strict)
    assert not once.is_whole
    assert found.is_whole
    assert problem.simulated - before > problem.steps * (CHEAP.samples + 1)

    def error(actions):
        trial = problem.simulate(problem.worlds(1), actions[None, : len(once.actions)])
        return shares(
            trial.object_pos, trial.object_quat, problem, 0, strict
        ).worst.mean()

    assert error(found.actions) < 0.8 * error(once.actions)


def test_a_window_that_is_near_enough_is_not_drawn_anew(make_problem):
    problem, rung = make_problem("right_box"), dataclasses.replace(CHEAP, rounds=4)
    costs = []
    for enough in (0.0, 1000.0):
        before = problem.simulated
        plan(problem, rung, enough=enough)
        costs.append(problem.simulated - before)
    strides = problem.steps  # played once besides
    assert costs[1] - strides < 0.3 * (costs[0] - strides)


def test_more_samples_come_closer(make_problem):
    """Against playback, by the errors of the whole motion in the untouched scene."""
    problem = make_problem("both")

    def error(actions):
        trial = problem.simulate(problem.worlds(1), actions[None])
        found = shares(trial.object_pos, trial.object_quat, problem, 0, LIMITS)
        return (found.pos + found.rot).mean()

    still = np.zeros((problem.steps, 2, problem.num_joints), np.float32)
    searched = plan(problem, Rung(samples=16, rounds=2, horizon=16))
    assert error(searched.actions) < 0.8 * error(still)


@pytest.mark.parametrize("side", ["left", "right"])
def test_closing_brings_the_fingertips_together(hands, side):
    """Against forward kinematics: how far the tips are from their middle."""
    import torch

    hand = hands[side]
    closing = closing_directions(hand)
    assert np.abs(closing).max() == 1
    assert not closing[:6].any()
    kinematics, middle = HandKinematics({side: hand}), hand.joint_range.mean(-1)
    middle[:6] = 0

    def spread(joints):
        q = torch.from_numpy(joints).float()[None, None]
        tips = kinematics(q, None)["tip_pos"][0, 0]
        return float((tips - tips.mean(0)).norm(dim=-1).sum())

    assert spread(middle + 0.1 * closing) < spread(middle) - 0.005
    assert spread(middle - 0.1 * closing) > spread(middle) + 0.005
