"""Reward terms against closed forms (method section 21)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flashdex.envs.mdp import rewards

ONE = torch.tensor([1.0, 0.0, 0.0, 0.0])


def quat(rotation):
    return torch.tensor(np.roll(rotation.as_quat(), 1, -1), dtype=torch.float32)


def object_term(points, pos, turn, *, rho=0.058, radius=None):
    radius = points.norm(dim=-1).max() if radius is None else radius
    scaled = rewards.rescale_points(points, radius, rho=rho)
    error = rewards.object_points_error(scaled, pos, turn, torch.zeros(3), ONE)
    return error, rewards.exp_kernel(error, sigma=0.1)


def test_object_term_is_one_at_the_reference():
    points = torch.randn(128, 3, generator=torch.Generator().manual_seed(0))
    error, reward = object_term(points, torch.zeros(3), ONE)
    assert error == 0
    assert reward == 1


def test_thirty_degrees_cost_three_centimetres():
    # three points at full radius, at right angles to the axis, however large
    circle = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, 0, 0.2]])
    turn = quat(Rotation.from_euler("z", 30, degrees=True))
    for size in (0.02, 0.3):
        error, reward = object_term(size * circle, torch.zeros(3), turn)
        assert error.item() == pytest.approx(0.03002, abs=5e-6)
        assert reward.item() == pytest.approx(0.7407, abs=1e-4)


@pytest.mark.parametrize("size", [0.01, 0.3])
def test_a_shift_costs_the_same_for_every_size(size):
    points = size * torch.randn(64, 3, generator=torch.Generator().manual_seed(1))
    shift = torch.tensor([0.03, -0.04, 0.0])
    _, reward = object_term(points, shift, ONE)
    assert reward.item() == pytest.approx(math.exp(-10 * 0.05), rel=1e-5)


def test_only_the_worst_points_count():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(128, 3)) * 0.03
    turn, pos = Rotation.from_rotvec([0.2, -0.4, 0.1]), np.array([0.01, 0.0, 0.02])
    radius = np.linalg.norm(points, axis=-1).max()
    scaled = points * 0.058 / radius
    gaps = np.sort(np.linalg.norm(turn.apply(scaled) + pos - scaled, axis=-1))
    error, _ = object_term(
        torch.tensor(points).float(), torch.tensor(pos).float(), quat(turn)
    )
    assert error.item() == pytest.approx(gaps[-3:].mean(), rel=1e-5)


def test_rho_zero_keeps_the_true_size():
    points = torch.randn(8, 3, generator=torch.Generator().manual_seed(3))
    assert torch.equal(rewards.rescale_points(points, torch.tensor(9.0), rho=0), points)


def test_radius_is_that_of_all_points_not_of_the_chosen_ones():
    points = torch.tensor([[0.01, 0.0, 0.0]])
    scaled = rewards.rescale_points(points, torch.tensor(0.1), rho=0.05)
    torch.testing.assert_close(scaled, torch.tensor([[0.005, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("excess", "value"), [(0.0, 1.0), (0.01, math.exp(-1)), (-0.03, 1.0)]
)
def test_interaction_term(excess, value):
    ref = torch.tensor([0.0, 0.003, 0.01, 0.02, 0.05])
    reward = rewards.fingertip_distance_exp(ref + excess, ref, sigma=0.01)
    assert reward.item() == pytest.approx(value, rel=1e-5)


def test_penetration_is_neither_paid_nor_punished():
    ref = torch.zeros(5)
    assert rewards.fingertip_distance_exp(ref - 0.02, ref, sigma=0.01) == 1


def test_tracking_terms():
    pos = torch.tensor([0.0, 0.03, 0.04])
    reward = rewards.wrist_pos_error_exp(pos, torch.zeros(3), scale=10.0)
    assert reward.item() == pytest.approx(math.exp(-0.5))
    turn = quat(Rotation.from_rotvec([0.0, 0.4, 0.3]))
    reward = rewards.wrist_rot_error_exp(-turn, ONE, scale=3.0)
    assert reward.item() == pytest.approx(math.exp(-1.5), rel=1e-5)
    tips = torch.zeros(5, 3)
    tips[2, 0] = 0.05
    reward = rewards.fingertip_pos_error_exp(tips, torch.zeros(5, 3), scale=20.0)
    assert reward.item() == pytest.approx((4 + math.exp(-1)) / 5)


def test_behaviour_cloning():
    # figures of method section 9: a finger of 1.5 rad, 0.1 rad off, pays .19;
    # a wrist slide of 10 m, 5 cm off, still .94
    value = rewards.behaviour_cloning_exp(
        torch.tensor([0.1]), torch.zeros(1), torch.tensor([1.5]), scale=500.0
    )
    assert value.item() == pytest.approx(0.189, abs=1e-3)
    value = rewards.behaviour_cloning_exp(
        torch.tensor([0.05, 0.0]),
        torch.zeros(2),
        torch.tensor([10.0, 1.0]),
        scale=500.0,
    )
    assert value.item() == pytest.approx((0.9394 + 1) / 2, abs=1e-4)


def test_object_pose_and_action_terms():
    turn = quat(Rotation.from_euler("x", 0.5))
    value = rewards.object_pose_exp(
        torch.tensor([0.1, 0.0, 0.0]), turn, torch.zeros(3), ONE
    )
    assert value.item() == pytest.approx(math.exp(-1.5), rel=1e-5)
    assert rewards.action_l2(torch.tensor([1.0, -1.0, 0.0, 0.0])).item() == 0.5


def test_each_hand_gets_half_but_pays_failures_whole():
    terms = {
        "object_points": torch.tensor([[1.0, 0.5]]),
        "failure": torch.tensor([[0.0, 1.0]]),
    }
    weights = {"object_points": 1.0, "failure": -100.0}
    total = rewards.weighted_sum(terms, weights, step_dt=1 / 60)
    expected = torch.tensor([[0.5 / 60, (0.25 - 100) / 60]])
    torch.testing.assert_close(total, expected)
