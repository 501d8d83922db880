"""Virtual-object assist: a fading PD wrench on the objects (method section 11)."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_rotvec,
)

if TYPE_CHECKING:
    from flashdex.recipe import AssistConfig

GRAVITY = 9.81  # m/s2


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

    Args:
        pose: object position and quaternion, world, (N, O, 7).
        vel: linear and angular velocity, world, (N, O, 6).
        ref_pose: reference, (N, O, 7).
        ref_vel: reference, (N, O, 6).
        inertia: about the centre of mass, object axes, kg m2, (N, O, 3, 3).
        kp: stiffness of each world, N/m, (N,).
        kv: damping of each world, N s/m, (N,).
        torque_ratio: angular over linear stiffness.
        force_limit: N.
        torque_limit: N m.

    Returns:
        Force and torque in world axes, (N, O, 6).
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

    Args:
        pose: object position and quaternion, world, (N, O, 7).
        vel: linear and angular velocity, world, (N, O, 6).
        ref_pose: reference, (N, O, 7).
        ref_vel: reference, (N, O, 6).
        mass: kg, (N, O).
        inertia: about the centre of mass, object axes, kg m2, (N, O, 3, 3).
        share: 1 right after the reset, falling to 0, (N,).
        stiffness: w, rad/s.

    Returns:
        Force and torque in world axes, (N, O, 6).
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


class AssistSchedule:
    """Decides when the assist fades, epoch by epoch.

    The dial-back is evaluated before the gates and pops an explicit stack of levels,
    so that it can act; in the released code it stands behind a gate that excludes it.

    Args:
        config: gains, gates and periods.

    Attributes:
        upper: present (kp, kv).
        lower: lower end of the per-world draw.
    """

    def __init__(self, config: AssistConfig) -> None:
        self.config = config
        self.upper = (config.kp, config.kv)
        self.lower = (config.kp, config.kv)
        self._levels: list[tuple[tuple[float, float], tuple[float, float]]] = []
        self._history: deque[tuple[float, float, float, float]] = deque(
            maxlen=config.window_epochs
        )
        self.epoch = 0
        self._changed_at = 0

    @property
    def active(self) -> bool:
        """Whether any wrench is left."""
        return self.config.enabled and self.upper[0] > 0

    def end_epoch(
        self, task: float, imitation: float, cloning: float, completion: float
    ) -> bool:
        """Record one epoch's means; return True when the gains changed.

        Args:
            task: weighted object term summed over hands, 0..1.
            imitation: weighted hand-tracking reward.
            cloning: behaviour-cloning reward.
            completion: share of episodes that ended without failure; 1 without ends.
        """
        self.epoch += 1
        self._history.append((task, imitation, cloning, completion))
        if not self.active:
            return False
        return self._dial_back() or self._decay()

    def _means(self) -> tuple[float, ...]:
        rows = list(self._history)
        return tuple(sum(r[i] for r in rows) / len(rows) for i in range(4))

    def _dial_back(self) -> bool:
        c = self.config
        waited = self.epoch - self._changed_at > c.dial_back_epochs
        if not (c.dial_back and self._levels and waited):
            return False
        if self._means()[3] >= c.dial_back_completion:
            return False
        upper, lower = self._levels.pop()
        factor = c.dial_back_factor
        self.upper = (upper[0] * factor, upper[1] * factor)
        self.lower = (lower[0] * factor, lower[1] * factor)
        self._restart()
        return True

    def _decay(self) -> bool:
        c = self.config
        if self.epoch < c.wait_epochs:
            return False
        if self._changed_at and self.epoch - self._changed_at < c.cooldown_epochs:
            return False
        task, imitation, cloning, completion = self._means()
        gates = (
            task >= c.task_gate
            and imitation >= c.imitation_gate
            and cloning >= c.bc_gate
            and completion >= c.completion_gate
        )
        if not gates:
            return False
        self._levels.append((self.upper, self.lower))
        self.upper = (self.upper[0] * c.decay, self.upper[1] * c.decay)
        self.lower = (self.upper[0] * c.lower_ratio, self.upper[1] * c.lower_ratio)
        if self.upper[0] < c.zero_below:
            self.upper = self.lower = (0.0, 0.0)
        elif self.lower[0] < c.lower_zero_below:
            self.lower = (0.0, 0.0)
        self._restart()
        return True

    def _restart(self) -> None:
        self._history.clear()
        self._changed_at = self.epoch

    def draw(self, num_envs: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw each world's gains uniformly between lower and upper, (N,) each."""
        share = torch.rand(num_envs, generator=generator)
        kp = self.lower[0] + share * (self.upper[0] - self.lower[0])
        kv = self.lower[1] + share * (self.upper[1] - self.lower[1])
        return kp, kv

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        return {
            "upper": self.upper,
            "lower": self.lower,
            "levels": list(self._levels),
            "history": list(self._history),
            "epoch": self.epoch,
            "changed_at": self._changed_at,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.upper, self.lower = tuple(state["upper"]), tuple(state["lower"])
        self._levels = [(tuple(u), tuple(v)) for u, v in state["levels"]]
        self._history.clear()
        self._history.extend(tuple(row) for row in state["history"])
        self.epoch, self._changed_at = state["epoch"], state["changed_at"]
