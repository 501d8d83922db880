"""Joint references of both robot hands: batched inverse kinematics that holds contact.

Every frame of a motion is solved at once by damped least squares,
    (J^T J + mu I) dq = -J^T r,
with residuals for fingertips, wrist, posture, smoothness, contact and penetration. In
contact frames the tips are pulled along the object's distance gradient until the pads
lie slightly inside its surface; all other parts of the hand are kept out of it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flashdex.datasets.tracks import rotation
from flashdex.geometry.sdf import SdfGrid
from flashdex.hands.collision_spheres import HandModel
from flashdex.hands.kinematics import HandJacobian, HandKinematics
from flashdex.hands.spec import HandSpec
from flashdex.keys import Side
from flashdex.motions.retarget.residuals import Residuals, RetargetWeights
from flashdex.motions.retarget.targets import Targets

MAX_STEP = 0.15  # m or rad a joint and iteration


def unwrap_wrist(quats: np.ndarray) -> np.ndarray:
    """Hinge angles with R = Rz(a) Rx(b) R-y(c), continuous over time, rad, (T, 3).

    Each orientation has two solutions, (a, b, c) and (a + pi, pi - b, c + pi); the one
    nearer to the previous frame is taken, up to full turns.

    Args:
        quats: wanted orientation of the base, wxyz, (T, 4).
    """
    with warnings.catch_warnings():
        # at the singularity scipy warns and picks a valid solution, which is enough
        warnings.simplefilter("ignore", UserWarning)
        first = rotation(quats).as_euler("ZXY") * np.array([1.0, 1.0, -1.0])
    other = np.stack([first[:, 0] + np.pi, np.pi - first[:, 1], first[:, 2] + np.pi], 1)
    out = first.copy()
    for t in range(1, len(quats)):
        options = [_near(o[t], out[t - 1]) for o in (first, other)]
        out[t] = min(options, key=lambda o, t=t: np.abs(o - out[t - 1]).sum())
    middle = (out.min(axis=0) + out.max(axis=0)) / 2
    return out - 2 * np.pi * np.round(middle / (2 * np.pi))


def _near(angles: np.ndarray, previous: np.ndarray) -> np.ndarray:
    return angles - 2 * np.pi * np.round((angles - previous) / (2 * np.pi))


@dataclass(frozen=True)
class Start:
    """Where the iterations of an attempt begin.

    Args:
        back: m that the hand is moved back along its palm normal. Then contact counts
            from the first iteration, so that fingers come to the object from outside
            and do not end up on its wrong side.
        curl: share of the fingers' range, 0 straight; None for a relaxed hand.
        side: m, a further shift in the world.
    """

    back: float = 0.0
    curl: float | None = None
    side: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class RetargetResult:
    """A joint reference."""

    joint_pos: np.ndarray  # m and rad, (T, 2, J)
    tip_error: np.ndarray  # robot pad to human tip, m, (T, 2, 5)


class Retargeter:
    """Solves joint references for one hand or both; where shapes say 2, as many.

    Example:
        >>> retargeter = Retargeter(load_hand("xhand"))  # doctest: +SKIP
        >>> result = retargeter.solve(targets, sdf)  # doctest: +SKIP
    """

    def __init__(
        self, specs: Mapping[Side, HandSpec], *, weights: RetargetWeights | None = None
    ) -> None:
        self.weights = weights or RetargetWeights()
        self.hand = HandModel(specs)
        self._kinematics = HandKinematics(specs).double()
        self._jacobian = HandJacobian(specs)

    @torch.no_grad()
    def solve(
        self, targets: Targets, sdf: SdfGrid, *, start: Start | None = None
    ) -> RetargetResult:
        """Joint references of all frames of a motion; both hands at once.

        The distance grids have a row a slot, float64. By default the iterations begin
        free of contact.
        """
        start = start or Start()
        residuals = Residuals(self.hand, targets, sdf, self.weights)
        free, held = self.weights.free_iterations, self.weights.contact_iterations
        q = self._initial(targets, start)
        for step in range(free + held):
            q = self._iterate(q, residuals, contact=start.back > 0 or step >= free)
        error = (self._kinematics(q)["tip_pos"] - targets.tips).norm(dim=-1)
        return RetargetResult(q.numpy(), error.numpy())

    def _initial(self, targets: Targets, start: Start) -> Tensor:
        """Wrist as the human palm wants it, moved back; fingers relaxed or curled."""
        q = self.hand.relaxed.repeat(len(targets.tips), 1, 1)
        if start.curl is not None:
            low, high = self.hand.low[:, 6:], self.hand.high[:, 6:]
            q[..., 6:] = low + start.curl * (high - low)
        side = torch.tensor(start.side, dtype=q.dtype)
        q[..., :3] = targets.wrist_pos + (side - start.back * targets.palm_normal)
        for hand in range(q.shape[1]):
            quats = targets.wrist_quat[:, hand].numpy()
            q[:, hand, 3:6] = torch.tensor(unwrap_wrist(quats))
        return q.clamp(self.hand.low, self.hand.high)

    def _iterate(self, q: Tensor, residuals: Residuals, *, contact: bool) -> Tensor:
        pose = self._kinematics(q)
        frames = self._jacobian.frames(q, pose["link_pos"], pose["link_quat"])
        slope = torch.zeros_like(q)
        eye = self.weights.damping * torch.eye(q.shape[-1], dtype=q.dtype)
        curvature = eye.expand(*q.shape, q.shape[-1]).clone()
        for residual, jac in residuals.evaluate(q, pose, frames, contact=contact):
            slope += torch.einsum("thr,thrj->thj", residual, jac)
            curvature += jac.transpose(-1, -2) @ jac
        # a joint at its limit that is pushed outwards takes no part in the step
        out = (q <= self.hand.low) & (slope > 0)
        out |= (q >= self.hand.high) & (slope < 0)
        slope = torch.where(out, 0.0, slope)
        curvature = torch.where(out[..., None] | out[..., None, :], 0.0, curvature)
        curvature += torch.diag_embed(out.to(q.dtype))
        step = -torch.linalg.solve(curvature, slope)
        scale = (MAX_STEP / step.abs().amax(-1, keepdim=True)).clamp(max=1.0)
        return (q + scale * step).clamp(self.hand.low, self.hand.high)
