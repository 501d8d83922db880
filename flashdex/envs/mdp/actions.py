"""From policy actions to joint position targets (method section 3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def lowpass_alpha(cutoff_hz: float, step_dt: float) -> float:
    """``alpha = w dt / (1 + w dt)``, ``w = 2 pi f``; .344 at 5 Hz and 60 Hz.

    A cut-off of 0 switches the filter off (alpha 1).
    """
    if cutoff_hz <= 0:
        return 1.0
    omega = 2 * math.pi * cutoff_hz * step_dt
    return omega / (1 + omega)


def lowpass(previous: Tensor, action: Tensor, fresh: Tensor, *, alpha: float) -> Tensor:
    """Exponential low-pass of wrist actions, (N, 2, 6); ``alpha`` weighs the new value.

    In ``fresh`` worlds, (N,) bool, which were just reset, the action passes through.
    """
    if alpha >= 1.0:  # not p + (a - p), which rounds
        return action
    filtered = previous + alpha * (action - previous)
    return torch.where(fresh[:, None, None], action, filtered)


def joint_target(
    wrist: Tensor,  # filtered wrist action in [-1, 1], (N, 2, 6)
    fingers: Tensor,  # finger action in [-1, 1], (N, 2, J - 6)
    ref_joint_pos: Tensor,  # reference of the step, (N, 2, J)
    joint_range: Tensor,  # lower and upper limits, (2, J, 2)
    *,
    wrist_scale: Tensor,  # m for slides, rad for hinges, (6,)
    # rad a unit of residual; None maps [-1, 1] to the joint range
    finger_scale: float | None,
) -> Tensor:
    """Hybrid action: wrist residual on the reference, fingers absolute or residual.

    Returns:
        Position targets within the joint limits, (N, 2, J).
    """
    lower, upper = joint_range.unbind(-1)
    target_wrist = ref_joint_pos[..., :6] + wrist * wrist_scale
    if finger_scale is None:
        middle = 0.5 * (lower + upper)[:, 6:]
        half = 0.5 * (upper - lower)[:, 6:]
        target_fingers = middle + fingers * half
    else:
        target_fingers = ref_joint_pos[..., 6:] + fingers * finger_scale
    target = torch.cat([target_wrist, target_fingers], -1)
    return torch.minimum(torch.maximum(target, lower), upper)
