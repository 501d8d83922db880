"""Tracking errors against closed forms."""

import math

import numpy as np
import pytest
import torch

from flashdex.geometry.rotation import quat_from_axis_angle
from flashdex.metrics.criteria import score
from flashdex.metrics.errors import (
    align_to_reference,
    centred_position_error,
    compute_tracking_errors,
    joint_position_error,
    reference_drift,
)

IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)


def one_object(pos, quat, ref_pos, ref_quat, **kwargs):
    data = {
        "object_pos": pos,
        "object_quat": quat,
        "ref_object_pos": ref_pos,
        "ref_object_quat": ref_quat,
    }
    masks = {"hand_active": (False, True), "hand_object": (-1, 0)}
    return compute_tracking_errors(data, **(masks | kwargs))


def rotation_error(angle, dtype=torch.float64):
    axis = torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64) / 3
    quat = quat_from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))
    quat, ref = quat.to(dtype).expand(3, 1, 4), IDENTITY.to(dtype).expand(3, 1, 4)
    zero = torch.zeros(3, 1, 3)
    return one_object(zero, quat, zero, ref).object_rot_error


@pytest.mark.parametrize("angle", [1e-7, 1e-3, 0.5, 3.0, math.pi])
def test_rotation_error_keeps_its_digits(angle):
    torch.testing.assert_close(
        rotation_error(angle),
        torch.full((3, 1), angle, dtype=torch.float64),
        atol=1e-9,
        rtol=0,
    )


def test_opposite_quaternions_are_the_same_rotation():
    quat = quat_from_axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(1.0))
    quat = quat.expand(4, 1, 4)
    zero = torch.zeros(4, 1, 3)
    assert one_object(zero, -quat, zero, quat).object_rot_error.max() < 1e-9


def test_turn_beyond_pi_is_the_shorter_way():
    error = rotation_error(math.pi + 0.4)
    assert error.max().item() == pytest.approx(math.pi - 0.4, abs=1e-12)


def test_centred_error_forgives_an_offset_only():
    offset = torch.randn(50, 2, 3, dtype=torch.float64)
    shifted = offset + torch.tensor([0.2, -0.1, 0.4], dtype=torch.float64)
    expected = np.linalg.norm(offset.numpy() - offset.numpy().mean(0), axis=-1)
    for value in (offset, shifted):
        np.testing.assert_allclose(centred_position_error(value), expected, atol=1e-12)


def test_joint_error_weighs_both_levels_equally():
    joints = torch.zeros(1, 4, 3)
    joints[0, :2, 0] = torch.tensor([0.1, 0.3])  # level 1: mean .2
    joints[0, 2:, 1] = torch.tensor([0.0, 0.08])  # distal: mean .04
    assert joint_position_error(joints, torch.zeros(1, 4, 3)).item() == pytest.approx(
        0.12
    )


def test_odd_number_of_joints_is_refused():
    with pytest.raises(ValueError, match="even"):
        joint_position_error(torch.zeros(1, 3, 3), torch.zeros(1, 3, 3))


def test_drift_of_a_linear_motion_is_half_its_length():
    ref = torch.zeros(11, 1, 3, dtype=torch.float64)
    ref[:, 0, 0] = torch.linspace(0, 0.2, 11)
    assert reference_drift(ref).item() == pytest.approx(0.1)


def test_twice_the_rate_scores_like_every_second_frame():
    generator = torch.Generator().manual_seed(0)
    ref = torch.cumsum(torch.randn(60, 1, 3, generator=generator) * 1e-2, 0)
    fast = (
        ref.repeat_interleave(2, 0) + torch.randn(120, 1, 3, generator=generator) * 0.03
    )
    quats = IDENTITY.expand(60, 1, 4)
    rows = align_to_reference(120, 60, fps=100, ref_fps=50)
    aligned = score(one_object(fast[rows], quats, ref, quats))
    # states after steps 2, 4, ... of the fast run belong to steps 1, 2, ... of the slow
    expected = score(one_object(fast[1::2], quats, ref, quats))
    assert aligned == expected
    assert aligned["sr_mt_obj"].values["object_pos"] > 0.01


@pytest.mark.parametrize(
    ("fps", "ref_fps", "first_step", "rows"),
    [
        (100, 50, 0, [0, 2, 4, 6]),
        (50, 50, 1, [0, 1, 2, 3]),
        (60, 50, 0, [0, 1, 2, 3]),
        (60, 50, 1, [0, 1, 2, 3]),
        (25, 50, 0, [0, 0, 1, 1]),
    ],
)
def test_alignment_takes_the_nearest_earlier_sample(fps, ref_fps, first_step, rows):
    result = align_to_reference(50, 4, fps=fps, ref_fps=ref_fps, first_step=first_step)
    assert result.tolist() == rows


def test_absent_data_is_named():
    zero, quats = torch.zeros(9, 1, 3), IDENTITY.expand(9, 1, 4)
    signals = one_object(zero, quats, zero, quats)
    assert signals.fingertip_error is None
    assert signals.missing["fingertips"] == "fingertips"


def test_hole_in_the_reference_is_missing_not_an_error():
    zero, quats = torch.zeros(9, 1, 3), IDENTITY.expand(9, 1, 4)
    holed = zero.clone()
    holed[3] = float("nan")
    signals = one_object(zero, quats, holed, quats)
    assert signals.object_pos_offset is None
    assert score(signals)["sr_mt_obj"].reason == "missing:ref_object_pos"


def test_static_check_sees_the_whole_reference():
    ref = torch.zeros(100, 1, 3)
    ref[20:, 0, 2] = 0.3
    zero, quats = torch.zeros(10, 1, 3), IDENTITY.expand(100, 1, 4)
    signals = one_object(zero, quats[:10], ref, quats)
    # the object has not moved yet when the rollout ends: incomplete, not unscorable
    assert score(signals)["sr_spider_raw"].reason == "incomplete"
