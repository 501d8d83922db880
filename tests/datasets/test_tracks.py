import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import GRASP, hand_keypoints
from flashdex.datasets.tracks import (
    angular_velocity,
    continuous,
    linear_velocity,
    palm_frame,
    resample,
    resample_pose,
    sample_times,
)
from flashdex.motions.retarget.solver import unwrap_wrist

AXIS = np.array([1.0, 2.0, -2.0]) / 3


def spin(times, rate):
    quats = Rotation.from_rotvec(rate * times[:, None] * AXIS).as_quat(
        scalar_first=True
    )
    return quats * np.where(np.arange(len(times)) % 2, -1, 1)[:, None]


def test_resampled_pose_is_the_closed_form():
    source = np.arange(31) / 30
    pose = np.concatenate(
        [np.outer(source, [1.0, -2.0, 0.5]), spin(source, 2.0)], axis=1
    )
    times = sample_times(31, 30.0, 50.0)
    assert len(times) == 51
    out = resample_pose(pose, 30.0, times)
    np.testing.assert_allclose(
        out[:, :3], np.outer(times, [1.0, -2.0, 0.5]), atol=1e-12
    )
    wanted = Rotation.from_rotvec(2.0 * times[:, None] * AXIS)
    got = Rotation.from_quat(out[:, 3:], scalar_first=True)
    assert (got * wanted.inv()).magnitude().max() < 1e-7
    assert np.einsum("ti,ti->t", out[1:, 3:], out[:-1, 3:]).min() > 0
    assert out[0, 3] >= 0


def test_times_do_not_reach_past_the_end():
    assert sample_times(30, 30.0, 60.0)[-1] == pytest.approx(29 / 30)
    assert sample_times(10, 25.0, 60.0)[-1] <= 9 / 25 + 1e-9


def test_resample_at_own_times_changes_nothing():
    values = np.random.default_rng(0).normal(size=(12, 4, 3))
    np.testing.assert_allclose(resample(values, 20.0, np.arange(12) / 20), values)


@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_velocities_of_uniform_motion(sigma):
    times = np.arange(40) / 60
    linear = linear_velocity(np.outer(times, [0.3, 0, -1.0]), 60.0, sigma=sigma)
    np.testing.assert_allclose(linear, np.tile([0.3, 0, -1.0], (40, 1)), atol=1e-9)
    angular = angular_velocity(spin(times, 4.0), 60.0, sigma=sigma)
    np.testing.assert_allclose(angular, np.tile(4.0 * AXIS, (40, 1)), atol=1e-6)


def test_continuous_removes_sign_flips():
    quats = spin(np.arange(50) / 10, 3.0)
    out = continuous(quats)
    assert np.einsum("ti,ti->t", out[1:], out[:-1]).min() > 0
    np.testing.assert_allclose(np.abs(np.sum(out * quats, -1)), 1.0)


@pytest.mark.parametrize("side", ["left", "right"])
def test_palm_frame_of_a_hand_in_its_own_frame(side):
    points = hand_keypoints(GRASP) * (1 if side == "right" else [1, -1, 1])
    turn = Rotation.from_rotvec([0.3, -1.0, 0.7])
    palm = palm_frame(turn.apply(points)[None], side)[0]
    matrix = turn.inv() * Rotation.from_quat(palm[3:], scalar_first=True)
    np.testing.assert_allclose(matrix.as_matrix(), np.eye(3), atol=1e-9)
    flexion = turn.inv().apply(turn.apply(points[12] - points[9]))
    assert flexion[2] > 0.02


def test_wrist_hinges_rebuild_the_orientation_without_jumps():
    times = np.arange(200) / 60
    rot = Rotation.from_rotvec(np.outer(np.sin(2 * times) * 2.5, [0.4, 1.0, 0.2]))
    angles = unwrap_wrist(rot.as_quat(scalar_first=True))
    z, x, y = np.eye(3)[[2, 0, 1]]
    built = (
        Rotation.from_rotvec(angles[:, :1] * z)
        * Rotation.from_rotvec(angles[:, 1:2] * x)
        * Rotation.from_rotvec(angles[:, 2:] * -y)
    )
    assert (built * rot.inv()).magnitude().max() < 1e-6
    assert np.abs(np.diff(angles, axis=0)).max() < 1.0
