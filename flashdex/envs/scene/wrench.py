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
LIMITS = ("hold_stiffness", "torque_ratio", "force_limit", "torque_limit")


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

        ``pose`` is position and quaternion, (N, O, 7), ``vel`` the linear and angular
        velocity, (N, O, 6), both in the world.
        """
        total = self.carry(pose, vel)
        if self.assists:
            total = total + self.pull(pose, vel)
        return torch.where(self.present.unsqueeze(-1), total, 0.0)

    def carry(self, pose: Tensor, vel: Tensor) -> Tensor:
        """Carry each object along its reference while a grip forms after a reset.

        A reference pose in mid grasp has no grip force yet: without help the object
        falls some centimetres before the fingers have closed. Critically damped,
        mass-normalised, gravity included, torques alike with the inertia:
        ``F = hold m (w^2 (x_ref - x) + 2 w (v_ref - v) + g)``.
        """
        stiffness, quat = self.hold_stiffness, pose[..., 3:]
        turn = quat_to_rotvec(quat_mul(self.ref_pose[..., 3:], quat_conj(quat)))
        offset = torch.cat([self.ref_pose[..., :3] - pose[..., :3], turn], -1)
        accel = stiffness**2 * offset + 2 * stiffness * (self.ref_vel - vel)
        force = accel[..., :3]
        force[..., 2] += GRAVITY
        torque = self._torque(quat, accel[..., 3:])
        wrench = torch.cat([self.mass.unsqueeze(-1) * force, torque], -1)
        return self.hold[:, None, None] * wrench

    def pull(self, pose: Tensor, vel: Tensor) -> Tensor:
        """PD wrench that pulls each object to its reference: the assist.

        ``F = kp (x_ref - x) + kv (v_ref - v)`` and
        ``tau = I_w [ratio kp rotvec(R_ref R^T) + sqrt(ratio) kv (w_ref - w)]``,
        each component clamped.
        """
        kp, kv = self.kp[:, None, None], self.kv[:, None, None]
        lag = self.ref_vel - vel
        force = kp * (self.ref_pose[..., :3] - pose[..., :3])
        force = force + kv * lag[..., :3]
        quat = pose[..., 3:]
        turn = quat_to_rotvec(quat_mul(self.ref_pose[..., 3:], quat_conj(quat)))
        accel = self.torque_ratio * kp * turn
        accel = accel + math.sqrt(self.torque_ratio) * kv * lag[..., 3:]
        torque = self._torque(quat, accel)
        force = force.clamp(-self.force_limit, self.force_limit)
        torque = torque.clamp(-self.torque_limit, self.torque_limit)
        return torch.cat([force, torque], -1)

    def _torque(self, quat: Tensor, accel: Tensor) -> Tensor:
        """Torque of an angular acceleration, both in world axes, (N, O, 3)."""
        local = quat_rotate_inverse(quat, accel).unsqueeze(-1)
        return quat_rotate(quat, (self.inertia @ local).squeeze(-1))


def hold_share(steps: Tensor, held: Tensor, hold_steps: float) -> Tensor:
    """Share of the hold that is left: 1 after a reset, then down to 0, (N,).

    ``steps`` since the reset are control steps, (N,), as are ``hold_steps``, of which 0
    is no hold; ``held`` are the worlds that are held at all, (N,) bool.
    """
    if hold_steps <= 0:
        return torch.zeros_like(held, dtype=torch.float32)
    share = (1.0 - steps / hold_steps).clamp_min(0.0)
    return torch.where(held, share, 0.0)
