"""Rotations against group axioms, scipy and closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flashdex.geometry import rotation as rot

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


@pytest.fixture
def quats():
    generator = torch.Generator().manual_seed(3)
    raw = torch.randn(3, 200, 4, generator=generator, dtype=torch.float64)
    return rot.quat_normalize(raw)


@pytest.fixture
def vectors():
    generator = torch.Generator().manual_seed(4)
    return torch.randn(200, 3, generator=generator, dtype=torch.float64)


def to_scipy(q):
    return Rotation.from_quat(q.numpy(), scalar_first=True)


def close(a, b, tol=1e-12):
    torch.testing.assert_close(a, torch.as_tensor(b), rtol=0, atol=tol)


def test_product_is_a_group(quats):
    a, b, c = quats
    close(rot.quat_mul(rot.quat_mul(a, b), c), rot.quat_mul(a, rot.quat_mul(b, c)))
    close(rot.quat_mul(a, IDENTITY), a)
    close(rot.quat_mul(a, rot.quat_conj(a)), IDENTITY.expand_as(a))
    close(rot.quat_mul(a, b).norm(dim=-1), torch.ones(200, dtype=torch.float64))


def test_product_rotates_by_second_factor_first(quats, vectors):
    a, b, _ = quats
    once = rot.quat_rotate(rot.quat_mul(a, b), vectors)
    close(once, rot.quat_rotate(a, rot.quat_rotate(b, vectors)))
    close(once, (to_scipy(a) * to_scipy(b)).apply(vectors.numpy()))


def test_rotate_quarter_turn_golden():
    half = math.sqrt(0.5)
    about_z = torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64)
    x, y, _ = torch.eye(3, dtype=torch.float64)
    close(rot.quat_rotate(about_z, x), y)
    close(rot.quat_rotate_inverse(about_z, y), x)


def test_matrix_matches_scipy(quats):
    q = quats[0]
    close(rot.quat_to_matrix(q), to_scipy(q).as_matrix())


def test_tiny_angle_keeps_its_digits():
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    angle = torch.tensor(1e-7, dtype=torch.float64)
    base = rot.quat_normalize(torch.tensor([0.3, -0.5, 0.2, 0.9], dtype=torch.float64))
    turned = rot.quat_mul(base, rot.quat_from_axis_angle(axis, angle))
    assert abs(rot.quat_angle(base, turned).item() - 1e-7) < 1e-9
    vector = rot.quat_to_rotvec(rot.quat_from_rotvec(axis * angle))
    close(vector, axis * 1e-7, tol=1e-16)


def test_half_turn_is_finite():
    axis = torch.tensor([0.0, 0.6, -0.8], dtype=torch.float64)
    q = rot.quat_from_axis_angle(axis, torch.tensor(math.pi, dtype=torch.float64))
    close(rot.quat_angle(q, IDENTITY), torch.tensor(math.pi, dtype=torch.float64))
    vector = rot.quat_to_rotvec(q)
    assert torch.isfinite(vector).all()
    close(vector.norm(), torch.tensor(math.pi, dtype=torch.float64))


def test_both_signs_are_one_rotation(quats, vectors):
    a, b, _ = quats
    close(rot.quat_angle(a, b), rot.quat_angle(-a, b))
    close(rot.quat_to_rotvec(a), rot.quat_to_rotvec(-a))
    close(rot.quat_rotate(a, vectors), rot.quat_rotate(-a, vectors))
    close(rot.quat_angle(a, -a), torch.zeros(200, dtype=torch.float64))


def test_angle_and_rotvec_match_scipy(quats):
    a, b, _ = quats
    close(rot.quat_angle(a, b), (to_scipy(a).inv() * to_scipy(b)).magnitude())
    close(rot.quat_to_rotvec(a), to_scipy(a).as_rotvec())
    close(rot.quat_angle(rot.quat_from_rotvec(rot.quat_to_rotvec(a)), a), np.zeros(200))


def test_gradients_are_finite_at_identity():
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    q = rot.quat_from_rotvec(vector)
    (rot.quat_to_rotvec(q).sum() + rot.quat_angle(q, IDENTITY)).backward()
    close(vector.grad, torch.ones(3, dtype=torch.float64))


def test_transform_points_matches_the_matrix(quats, vectors):
    pos, quat = vectors[:5], quats[0, :5]
    points = vectors.view(5, 40, 3)
    turned = np.einsum("bij,bpj->bpi", to_scipy(quat).as_matrix(), points.numpy())
    close(rot.transform_points(pos, quat, points), turned + pos[:, None].numpy())


def test_leading_axes_broadcast_and_dtype_stays():
    q = rot.quat_normalize(torch.ones(4, 1, 2, 4))
    v = torch.ones(3, 1, 3)
    assert rot.quat_rotate(q, v).shape == (4, 3, 2, 3)
    assert rot.quat_mul(q, q[0, 0, 0]).dtype == torch.float32
    assert rot.quat_from_axis_angle(torch.eye(3), torch.zeros(7, 1)).shape == (7, 3, 4)
