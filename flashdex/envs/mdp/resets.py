"""Start states: reference frame plus noise (method section 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from flashdex.envs.mdp.samplers import start_frames
from flashdex.envs.reference import ReferenceBank
from flashdex.system.fields import number


@dataclass(frozen=True)
class ResetDraw:
    """What a reset of n worlds has drawn."""

    motion: Tensor  # motion rows, (n,)
    frame: Tensor  # start frames, (n,)
    pos_noise: Tensor  # added to the joint positions, m and rad, (n, 2, J)
    vel_noise: Tensor  # added to the wrist velocity, (n, 2, 6)
    # replaces the finger velocity, rad/s, (n, 2, J - 6); NaN keeps it
    finger_vel: Tensor


def draw_reset(
    motion: Tensor,  # motion rows, (n,)
    from_start: Tensor,  # start at frame 0, (n,) bool
    noiseless: Tensor,  # no noise, reference velocities, (n,) bool
    length: Tensor,  # frames of each motion, (n,)
    noise: ResetNoise,  # standard deviations
    joint_range: Tensor,  # (2, J, 2)
    generator: torch.Generator,  # source of randomness
) -> ResetDraw:
    """Draw start frames and noise for n worlds."""
    n, joints = len(motion), joint_range.shape[1]
    frame = start_frames(length, generator)
    frame = torch.where(from_start, torch.zeros_like(frame), frame)
    shape, device = (n, 2, joints), motion.device
    draw = torch.randn(shape, generator=generator, device=device)
    vel = torch.randn(shape, generator=generator, device=device)
    span = joint_range[..., 1] - joint_range[..., 0]
    std = noise.finger_range * span
    std[:, :3] = noise.wrist_pos
    std[:, 3:6] = math.radians(noise.wrist_rot_deg)
    noiseless = noiseless[:, None, None]
    finger_vel = vel[..., 6:] * noise.finger_vel
    return ResetDraw(
        motion=motion,
        frame=frame,
        pos_noise=torch.where(noiseless, 0.0, draw * std),
        vel_noise=torch.where(noiseless, 0.0, vel[..., :6] * noise.wrist_vel),
        finger_vel=torch.where(noiseless, math.nan, finger_vel),
    )


def reset_state(
    draw: ResetDraw, bank: ReferenceBank, joint_range: Tensor
) -> dict[str, Tensor]:
    """Turn a draw into the physical state of n worlds, within the ranges (2, J, 2).

    Returns:
        joint_pos, joint_vel (n, 2, J), object_pose (n, O, 7), object_vel (n, O, 6).
    """
    ref = bank.at(draw.motion, draw.frame)
    pos = ref["joint_pos"] + draw.pos_noise
    pos = torch.minimum(torch.maximum(pos, joint_range[..., 0]), joint_range[..., 1])
    wrist = ref["joint_vel"][..., :6] + draw.vel_noise
    kept = draw.finger_vel.isnan()
    fingers = torch.where(kept, ref["joint_vel"][..., 6:], draw.finger_vel)
    return {
        "joint_pos": pos,
        "joint_vel": torch.cat([wrist, fingers], -1),
        "object_pose": torch.cat([ref["object_pos"], ref["object_quat"]], -1),
        "object_vel": torch.cat([ref["object_linvel"], ref["object_angvel"]], -1),
    }


def first_state(
    bank: ReferenceBank, row: int, joint_range: Tensor
) -> dict[str, Tensor]:
    """The state that every attempt at a motion starts from, batch 1.

    See ``reset_state``; frame 0, without noise.
    """
    always = torch.tensor([True])
    draw = draw_reset(
        torch.tensor([row]),
        *(always, always),
        bank.length[[row]],
        ResetNoise(),
        joint_range,
        torch.Generator(),
    )
    return reset_state(draw, bank, joint_range)


@dataclass(frozen=True, kw_only=True)
class ResetNoise:
    """Standard deviations of the start state around the reference."""

    wrist_pos: float = number(0.001, low=0, high=1)
    """Wrist position, m."""
    wrist_rot_deg: float = number(1.0, low=0, high=180)
    """Wrist orientation, degrees."""
    finger_range: float = number(0.0125, low=0, high=1)
    """Finger joints, share of the joint range."""
    wrist_vel: float = number(0.001, low=0, high=100)
    """Added to the wrist velocity, m/s and rad/s."""
    finger_vel: float = number(0.01, low=0, high=100)
    """Replaces the finger velocity, rad/s."""
