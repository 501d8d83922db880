"""What acts on objects besides contact and gravity: assist and the hold after a reset.

Engines evaluate it before every substep, on their own device: the tensors stay those
of the control step, the object state is the present one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_rotvec,
)

GRAVITY = 9.81  # m/s2


@dataclass(frozen=True)
class ObjectWrench:
    """Assist and hold of all worlds during one control step."""

    ref_pose: Tensor  # reference position and quaternion, world, (N, O, 7)
    ref_vel: Tensor  # reference linear and angular velocity, world, (N, O, 6)
    mass: Tensor  # kg, (N, O)
    inertia: Tensor  # about the centre of mass, object axes, kg m2, (N, O, 3, 3)
    present: Tensor  # the slot holds an object, (N, O) bool
    hold: Tensor  # share of the hold after a reset, 0..1, (N,)
    kp: Tensor  # assist stiffness, N/m, (N,)
    kv: Tensor  # assist damping, N s/m, (N,)
    hold_stiffness: float  # natural frequency of the hold, rad/s
    torque_ratio: float  # angular over linear stiffness of the assist
    force_limit: float  # of the assist, each component, N
    torque_limit: float  # of the assist, each component, N m
    # any world has assist gains; without them the term is left out
    assists: bool = True

    def __call__(self, pose: Tensor, vel: Tensor) -> Tensor:
        """Force and torque on each object, world axes, (N, O, 6).

        Args:
            pose: object position and quaternion, world, (N, O, 7).
            vel: linear and angular velocity, world, (N, O, 6).
        """
        total = hold_wrench(
            pose,
            vel,
            self.ref_pose,
            self.ref_vel,
            self.mass,
            self.inertia,
            self.hold,
            stiffness=self.hold_stiffness,
        )
        if self.assists:
            total = total + assist_wrench(
                pose,
                vel,
                self.ref_pose,
                self.ref_vel,
                self.inertia,
                self.kp,
                self.kv,
                torque_ratio=self.torque_ratio,
                force_limit=self.force_limit,
                torque_limit=self.torque_limit,
            )
        return torch.where(self.present.unsqueeze(-1), total, 0.0)


def hold_share(steps: Tensor, held: Tensor, hold_steps: float) -> Tensor:
    """Share of the hold that is left: 1 after a reset, then down to 0, (N,).

    Args:
        steps: control steps since the reset, (N,).
        held: worlds that are held at all, (N,) bool.
        hold_steps: how long the hold lasts; 0 is no hold.
    """
    if hold_steps <= 0:
        return torch.zeros_like(held, dtype=torch.float32)
    share = (1.0 - steps / hold_steps).clamp_min(0.0)
    return torch.where(held, share, 0.0)


def assist_wrench(
    pose: Tensor,
    vel: Tensor,
    ref_pose: Tensor,
    ref_vel: Tensor,
    inertia: Tensor,
    kp: Tensor,
    kv: Tensor,
    *,
    torque_ratio: float,
    force_limit: float,
    torque_limit: float,
) -> Tensor:
    """PD wrench that pulls each object to its reference.

    ``F = kp (x_ref - x) + kv (v_ref - v)`` and
    ``tau = I_w [ratio kp rotvec(R_ref R^T) + sqrt(ratio) kv (w_ref - w)]``,
    each component clamped.

    Arguments are those of `ObjectWrench` and its call; force and torque, world axes,
    (N, O, 6).
    """
    kp, kv = kp[:, None, None], kv[:, None, None]
    force = kp * (ref_pose[..., :3] - pose[..., :3])
    force = force + kv * (ref_vel[..., :3] - vel[..., :3])
    quat = pose[..., 3:]
    turn = quat_to_rotvec(quat_mul(ref_pose[..., 3:], quat_conj(quat)))
    accel = torque_ratio * kp * turn
    accel = accel + math.sqrt(torque_ratio) * kv * (ref_vel[..., 3:] - vel[..., 3:])
    local = quat_rotate_inverse(quat, accel)
    torque = quat_rotate(quat, (inertia @ local.unsqueeze(-1)).squeeze(-1))
    force = force.clamp(-force_limit, force_limit)
    return torch.cat([force, torque.clamp(-torque_limit, torque_limit)], -1)


def hold_wrench(
    pose: Tensor,
    vel: Tensor,
    ref_pose: Tensor,
    ref_vel: Tensor,
    mass: Tensor,
    inertia: Tensor,
    share: Tensor,
    *,
    stiffness: float,
) -> Tensor:
    """Carry each object along its reference while a grip forms after a reset.

    A reference pose in mid grasp has no grip force yet: without help the object falls
    some centimetres before the fingers have closed. Critically damped, mass-normalised,
    gravity included: ``F = share m (w^2 (x_ref - x) + 2 w (v_ref - v) + g)``, torques
    alike with the inertia.

    ``share`` is 1 right after the reset and falls to 0, (N,); ``stiffness`` is w,
    rad/s. Other arguments are those of `ObjectWrench` and its call; force and torque,
    world axes, (N, O, 6).
    """
    quat = pose[..., 3:]
    turn = quat_to_rotvec(quat_mul(ref_pose[..., 3:], quat_conj(quat)))
    offset = torch.cat([ref_pose[..., :3] - pose[..., :3], turn], -1)
    accel = stiffness**2 * offset + 2 * stiffness * (ref_vel - vel)
    force = accel[..., :3]
    force[..., 2] += GRAVITY
    local = quat_rotate_inverse(quat, accel[..., 3:]).unsqueeze(-1)
    torque = quat_rotate(quat, (inertia @ local).squeeze(-1))
    wrench = torch.cat([mass.unsqueeze(-1) * force, torque], -1)
    return share[:, None, None] * wrench
