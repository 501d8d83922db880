"""Several attempts at a joint reference, and the choice among them.

Inverse kinematics in contact has several valleys: fingers that start on the wrong side
of a handle stay there. The attempts differ in where the hand comes from; the one kept
has the least

    mean tip error + 0.5 x largest penetration + 0.01 m/rad x largest finger jerk,

the last term because a reference that changes valleys from frame to frame cannot be
followed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flashdex.geometry.sdf import SdfGrid
from flashdex.motions.retarget.penetration import Penetration
from flashdex.motions.retarget.residuals import Targets
from flashdex.motions.retarget.solver import Retargeter, Start

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


@dataclass(frozen=True)
class Attempt:
    """One solution.

    Args:
        joint_pos: hands without a part in it parked, m and rad, (T, 2, J).
        tip_error: robot pad to human tip, m, (T, H, 5), hands that take part.
        depth: penetration by MuJoCo's collisions.
        score: m, less is better.
    """

    joint_pos: np.ndarray
    tip_error: np.ndarray
    depth: Penetration
    score: float


@dataclass(frozen=True)
class Choice:
    """The best attempt, and the scores of those made, in order, m."""

    best: Attempt
    scores: list[float]


def make_starts(count: int, *, seed: int = 0) -> list[Start]:
    """Starts of ``count`` attempts: the fixed ones first, then random ones."""
    rng = np.random.default_rng(seed)
    starts = list(FIXED[:count])
    while len(starts) < count:
        x, y, z = rng.uniform(-SIDE, SIDE, 3)
        back, curl = rng.uniform(*BACK), rng.uniform(*CURL)
        starts.append(Start(back=back, curl=curl, side=(x, y, z)))
    return starts


def choose_attempt(
    retargeter: Retargeter,
    targets: Targets,
    sdf: SdfGrid,
    *,
    count: int,
    park: Callable[[np.ndarray], np.ndarray],
    measure: Callable[[np.ndarray], Penetration],
) -> Choice:
    """Solve up to ``count`` times and keep the best; a clean solution ends it.

    Args:
        retargeter: of the H hands that take part.
        targets: of the same hands.
        sdf: distance grids of the objects.
        count: most attempts.
        park: adds the hands that take no part, (T, H, J) to (T, 2, J).
        measure: penetration of joint positions (T, 2, J).
    """
    attempts = []
    for start in make_starts(count):
        result = retargeter.solve(targets, sdf, start=start)
        joint_pos = park(result.joint_pos)
        depth = measure(joint_pos)
        deepest = float(depth.objects.max(initial=0.0))
        fingers = result.joint_pos[..., 6:]
        jerk = np.abs(np.diff(fingers, n=2, axis=0)).max(initial=0.0)
        score = float(result.tip_error.mean()) + PENETRATION_SHARE * deepest
        score += JERK_COST * float(jerk)
        attempts.append(Attempt(joint_pos, result.tip_error, depth, score))
        if deepest < CLEAN_DEPTH and jerk < CLEAN_JERK:
            break
    best = min(attempts, key=lambda attempt: attempt.score)
    return Choice(best, [round(a.score, 5) for a in attempts])
