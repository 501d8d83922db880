"""Several attempts at a joint reference, and the choice among them.

Inverse kinematics in contact has several valleys: fingers that start on the wrong side
of a handle stay there. The attempts differ in where the hand comes from; the one kept
has the least

    mean tip error + 0.5 x largest penetration + 0.01 m/rad x largest finger jerk,

the last term because a reference that changes valleys from frame to frame cannot be
followed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from flashdex.hands.collision_spheres import HandModel
from flashdex.hands.spec import HandSpec
from flashdex.keys import SIDES, Side
from flashdex.motions.contact.roles import Interaction
from flashdex.motions.retarget.penetration import (
    Penetration,
    make_reference_scene,
    measure_penetration,
)
from flashdex.motions.retarget.residuals import RetargetWeights
from flashdex.motions.retarget.solver import Retargeter, Start
from flashdex.motions.retarget.targets import Targets, make_targets
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.solid import make_slot_grid

PENETRATION_SHARE = 0.5
JERK_COST = 0.01  # m a rad
# A solution as clean as this ends the search: others differ by less than 1 mm of score
# (15 MyoDM clips, ten starts each), and most motions need one attempt only.
CLEAN_DEPTH, CLEAN_JERK = 0.004, 0.25  # m, rad
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

    Args:
        motion: with its roles.
        assets: its objects, by slot.
        specs: left and right hand.
        weights: of the residuals.
        attempts: at most.
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
