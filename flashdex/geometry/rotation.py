"""Rotations as unit quaternions in wxyz order: pure functions, any leading shape.

Every function keeps the dtype and device of its inputs and broadcasts leading axes.
Angles are radians. ``q`` and ``-q`` are the same rotation; functions that return an
angle or a rotation vector treat them alike.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def quat_normalize(q: Tensor) -> Tensor:
    """Scale a quaternion, (..., 4) and not zero, to unit length."""
    return q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)


def quat_conj(q: Tensor) -> Tensor:
    """Inverse of a unit quaternion (..., 4): ``(w, -x, -y, -z)``."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of (..., 4): rotate by ``b`` first, then by ``a``.

    Example:
        >>> i = torch.tensor([0.0, 1.0, 0.0, 0.0])
        >>> j = torch.tensor([0.0, 0.0, 1.0, 0.0])
        >>> quat_mul(i, j)
        tensor([0., 0., 0., 1.])
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by unit quaternions (..., 4).

    ``v + 2 w (u x v) + 2 u x (u x v)`` with ``q = (w, u)``.
    """
    u, v = torch.broadcast_tensors(q[..., 1:], v)
    t = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors (..., 3) by the inverse of ``q`` (..., 4): world to body."""
    return quat_rotate(quat_conj(q), v)


def quat_to_matrix(q: Tensor) -> Tensor:
    """Matrix (..., 3, 3) of a unit quaternion; column ``i`` is the turned axis."""
    w, x, y, z = q.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def quat_from_axis_angle(axis: Tensor, angle: Tensor) -> Tensor:
    """``(cos(a/2), axis sin(a/2))`` of a unit axis (..., 3) and an angle (...), rad."""
    half = 0.5 * angle[..., None]
    xyz = axis * torch.sin(half)
    w = torch.cos(half).expand(*xyz.shape[:-1], 1)
    return torch.cat((w, xyz), dim=-1)


def quat_from_rotvec(v: Tensor) -> Tensor:
    """Exponential map: rotation vector (..., 3), rad, to (..., 4); smooth at zero."""
    half = 0.5 * torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    # sin(h) / (2 h) through sinc, which is finite at zero with its gradient.
    return torch.cat((torch.cos(half), 0.5 * v * torch.sinc(half / math.pi)), dim=-1)


def quat_to_rotvec(q: Tensor) -> Tensor:
    """Logarithm: the shortest rotation vector (..., 3), of length in [0, pi], rad."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, xyz = q[..., :1], q[..., 1:]
    sine = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    tiny = sine < torch.finfo(q.dtype).tiny ** 0.5
    # Below the square root of the smallest number angle / sine is 2 exactly.
    safe = torch.where(tiny, torch.ones_like(sine), sine)
    factor = torch.where(
        tiny, torch.full_like(sine, 2), 2 * torch.atan2(safe, w) / safe
    )
    return xyz * factor


def quat_angle(a: Tensor, b: Tensor) -> Tensor:
    """Geodesic angle ``2 atan2(sqrt(1 - c^2), c)`` with ``c = |<a, b>|``.

    The sine is taken from the vector part of ``conj(a) b``, which equals
    ``sqrt(1 - c^2)`` but keeps its digits when the angle is small.

    Returns:
        Angle in [0, pi], rad, (...).
    """
    delta = quat_mul(quat_conj(a), b)
    sine = torch.linalg.vector_norm(delta[..., 1:], dim=-1)
    return 2 * torch.atan2(sine, delta[..., 0].abs())


def transform_points(pos: Tensor, quat: Tensor, points: Tensor) -> Tensor:
    """Body to world: ``R p + pos`` of points (..., P, 3), m."""
    return points @ quat_to_matrix(quat).mT + pos[..., None, :]
