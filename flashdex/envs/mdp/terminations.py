"""Failure conditions with per-hand blame, as pure functions.

Each returns a mask (N, 2): the hand whose object or fingertips ended the episode.
A hand that takes no part in the motion is never blamed.
"""

from __future__ import annotations

import torch
from torch import Tensor


def object_dropped(pos: Tensor, ref_pos: Tensor, *, distance: float) -> Tensor:
    """Object lower than its reference by more than ``distance`` m; (N, 2, 3) each."""
    return pos[..., 2] < ref_pos[..., 2] - distance


def fingertip_off(
    pos: Tensor, ref_pos: Tensor, steps: Tensor, *, distance: float, grace: int
) -> Tensor:
    """Any fingertip farther than ``distance`` m from its human tip.

    Args:
        pos: robot fingertips, world, m, (N, 2, 5, 3).
        ref_pos: human fingertips, (N, 2, 5, 3).
        steps: control steps since the reset, (N,).
        distance: limit, m.
        grace: steps after the reset that are not judged.
    """
    off = ((pos - ref_pos).norm(dim=-1) > distance).any(-1)
    return off & (steps > grace).unsqueeze(-1)


def early_reset_line(steps: Tensor, *, threshold: float, window: int) -> Tensor:
    """Least sum of object rewards after n steps: ``0.6 * 5 * floor((n - 1) / 5)``."""
    blocks = torch.div(steps - 1, window, rounding_mode="floor").clamp_min(0)
    return threshold * window * blocks.float()


def early_reset(
    object_sum: Tensor,
    steps: Tensor,
    active: Tensor,
    *,
    threshold: float,
    window: int,
) -> Tensor:
    """Running object reward below the line; blames the hands below it themselves.

    Args:
        object_sum: sum of the raw object term (0..1 a step) since the reset, (N, 2).
        steps: control steps since the reset, (N,).
        active: hands that take part, (N, 2) bool.
        threshold: mean reward demanded, 0.6.
        window: steps of one block, 5.
    """
    line = early_reset_line(steps, threshold=threshold, window=window)
    weight = active.float()
    mean = (object_sum * weight).sum(-1) / weight.sum(-1).clamp_min(1.0)
    fires = (mean < line).unsqueeze(-1)
    return fires & (object_sum < line.unsqueeze(-1)) & active


def sanity(
    joint_vel: Tensor,
    link_linvel: Tensor,
    object_vel: Tensor,
    numerics: Tensor,
    *,
    max_link_speed: float,
    max_joint_speed: float,
    max_object_speed: float,
    max_object_spin: float,
) -> Tensor:
    """Impossible speeds or non-finite numbers; charges both hands, (N, 2).

    Args:
        joint_vel: (N, 2, J) rad/s.
        link_linvel: (N, 2, L, 3) m/s.
        object_vel: (N, O, 6) m/s and rad/s.
        numerics: engine reported a bad state, (N,) bool.
        max_link_speed: m/s.
        max_joint_speed: rad/s.
        max_object_speed: m/s.
        max_object_spin: rad/s.
    """
    bad = numerics.clone()
    bad |= ~torch.isfinite(joint_vel).flatten(1).all(1)
    bad |= ~torch.isfinite(object_vel).flatten(1).all(1)
    bad |= (joint_vel.abs() > max_joint_speed).flatten(1).any(1)
    bad |= (link_linvel.norm(dim=-1) > max_link_speed).flatten(1).any(1)
    bad |= (object_vel[..., :3].norm(dim=-1) > max_object_speed).any(1)
    bad |= (object_vel[..., 3:].norm(dim=-1) > max_object_spin).any(1)
    return bad.unsqueeze(-1).expand(-1, 2)
