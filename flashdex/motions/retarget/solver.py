"""Joint references of both robot hands: batched inverse kinematics that holds contact.

Every frame of a motion is solved at once by damped least squares,
    (J^T J + mu I) dq = -J^T r,
with residuals for fingertips, wrist, posture, smoothness, contact and penetration. In
contact frames the tips are pulled along the object's distance gradient until the pads
lie slightly inside its surface; all other parts of the hand are kept out of it.

The problem has several valleys: fingers that start on the wrong side of a handle stay
there. So there are several attempts, which differ in where the hand comes from; the one
kept has the least

    mean tip error + 0.5 x largest penetration + 0.01 m/rad x largest finger jerk,

the last term because a reference that changes valleys from frame to frame cannot be
followed.
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
from flashdex.keys import SIDES, Side
from flashdex.motions.contact.roles import Interaction
from flashdex.motions.retarget.penetration import (
    Penetration,
    make_reference_scene,
    measure_penetration,
)
from flashdex.motions.retarget.residuals import Residuals, RetargetWeights
from flashdex.motions.retarget.targets import Targets, make_targets
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.solid import make_slot_grid

MAX_STEP = 0.15  # m or rad a joint and iteration
PENETRATION_SHARE = 0.5
JERK_COST = 0.01  # m a rad
# A solution as clean as this ends the search: others differ by less than 1 mm of score
# (15 MyoDM clips, ten starts each), and most motions need one attempt only.
CLEAN_DEPTH, CLEAN_JERK = 0.004, 0.25  # m, rad


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

    Of a hand that is moved back, contact counts from the first iteration, so that the
    fingers come to the object from outside and do not end up on its wrong side.
    """

    back: float = 0.0  # m, against the palm normal
    curl: float | None = None  # share of the fingers' range, 0 straight; None: relaxed
    side: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, a further shift, world


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


FIXED = (
    Start(),
    Start(back=0.04, curl=0.1),
    Start(back=0.06, curl=0.4),
    Start(back=0.10, curl=0.25),
)
BACK, CURL, SIDE = (0.02, 0.12), (0.0, 0.6), 0.03  # ranges of random starts


# where the joints of a hand that takes no part rest, m: out of everyone's way
PARKED = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Attempt:
    """One solution; the H hands are those that take part."""

    joint_pos: np.ndarray  # the other hand is parked, m and rad, (T, 2, J)
    tip_error: np.ndarray  # robot pad to human tip, m, (T, H, 5)
    depth: Penetration  # by MuJoCo's collisions
    score: float  # m, less is better


@dataclass(frozen=True)
class Choice:
    """The best attempt, and the scores of those made, in order, m."""

    best: Attempt
    scores: list[float]


def retarget(
    motion: Interaction,
    assets: list[ObjectAsset],
    specs: Mapping[Side, HandSpec],
    *,
    weights: RetargetWeights,
    attempts: int,
) -> tuple[Choice, Targets]:
    """Attempts at a joint reference until one is clean; and what both hands aim at.

    The assets are the motion's objects, by slot.
    """
    targets = make_targets(motion, HandModel(specs))
    scene = make_reference_scene(specs, [a.parts for a in assets])
    sdf = make_slot_grid(assets, solid=True)
    acting = np.flatnonzero(motion.active)
    used: dict[Side, HandSpec] = {SIDES[h]: specs[SIDES[h]] for h in acting}
    retargeter = Retargeter(used, weights=weights)
    aims = targets.of(torch.tensor(acting))
    made = []
    for start in make_starts(attempts):
        result = retargeter.solve(aims, sdf, start=start)
        joint_pos = np.zeros((motion.num_frames, 2, result.joint_pos.shape[-1]))
        joint_pos[..., :3] = PARKED
        joint_pos[:, acting] = result.joint_pos
        depth = measure_penetration(
            scene, joint_pos, motion.poses, active=motion.active
        )
        deepest = float(depth.objects.max(initial=0.0))
        fingers = result.joint_pos[..., 6:]
        jerk = np.abs(np.diff(fingers, n=2, axis=0)).max(initial=0.0)
        score = float(result.tip_error.mean()) + PENETRATION_SHARE * deepest
        score += JERK_COST * float(jerk)
        made.append(Attempt(joint_pos, result.tip_error, depth, score))
        if deepest < CLEAN_DEPTH and jerk < CLEAN_JERK:
            break
    best = min(made, key=lambda attempt: attempt.score)
    return Choice(best, [round(a.score, 5) for a in made]), targets


def make_starts(count: int, *, seed: int = 0) -> list[Start]:
    """Starts of ``count`` attempts: the fixed ones first, then random ones."""
    rng = np.random.default_rng(seed)
    starts = list(FIXED[:count])
    while len(starts) < count:
        x, y, z = rng.uniform(-SIDE, SIDE, 3)
        back, curl = rng.uniform(*BACK), rng.uniform(*CURL)
        starts.append(Start(back=back, curl=curl, side=(x, y, z)))
    return starts
