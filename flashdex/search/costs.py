"""What a sequence of actions costs, as shares of the criterion's limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flashdex.metrics.criteria_table import Limits, make_criteria, resolve_criterion
from flashdex.search.config import SearchConfig
from flashdex.search.problem import Problem, Trial

Array = NDArray[np.float64]
LOST = 6.0  # shares of a limit beyond which it is all the same
TIP_SLACK, TIP_MAX = 0.01, 0.05  # m: free, and counted at most


@dataclass(frozen=True)
class Shares:
    """Errors of the objects over the limits of their means, (N, K, H, O)."""

    pos: Array
    rot: Array

    @property
    def worst(self) -> Array:
        """The larger one, of the object that is worse, (N, K, H)."""
        return np.maximum(self.pos, self.rot).max(-1)


@dataclass(frozen=True)
class ErrorLimits:
    """Means that a criterion allows: m and rad."""

    pos: float
    rot: float

    @classmethod
    def of(cls, criterion: str) -> ErrorLimits:
        """Limits of a named criterion; the usual ones of what it does not limit."""
        (found,) = [
            c for c in make_criteria() if c.name == resolve_criterion(criterion)
        ]
        terms = {term.quantity: term.limit for term in found.terms}
        usual = Limits()
        return cls(
            terms.get("object_pos", usual.object_pos),
            terms.get("object_rot", usual.object_rot),
        )


def shares(
    pos: Array, quat: Array, problem: Problem, first: int, limits: ErrorLimits
) -> Shares:
    """Errors of objects at pos, quat (N, K, H, O, .) from control step ``first`` on.

    A state that is not finite is far off.
    """
    steps = slice(first, first + pos.shape[2])
    pos = np.linalg.norm(pos - problem.ref_pos[steps], axis=-1)
    dot = np.abs((quat * problem.ref_quat[steps]).sum(-1)).clip(0, 1)
    return Shares(
        np.nan_to_num(pos / limits.pos, nan=100.0, posinf=100.0),
        np.nan_to_num(2 * np.arccos(dot) / limits.rot, nan=LOST),
    )


@dataclass(frozen=True)
class Costs:
    """Of N sequences."""

    total: Array  # (N,)
    error: Array  # mean share of the limits, of the object that is worse, (N,)


def cost(
    trial: Trial,
    knots: Array,
    noise: Array,
    problem: Problem,
    config: SearchConfig,
    first: int,
    limits: ErrorLimits,
) -> Costs:
    """Cost of N sequences, mean over the worlds.

    Objects count as shares of their limits, the end of the horizon more; fingertips
    that should touch by their distance from where they belong; then size and
    unsteadiness of the actions.

    Args:
        trial: what they led to.
        knots: of the actions, (N, Q, A, J).
        noise: standard deviations of the knots, (A, J).
        problem: of the motion.
        config: weights.
        first: control step that the sequences begin at.
        limits: of the criterion.
    """
    found = shares(trial.object_pos, trial.object_quat, problem, first, limits)
    steps = found.pos.shape[2]
    weight = np.ones(steps)
    if first + steps < problem.steps:
        weight[-max(1, steps // 4) :] += config.end_weight
    errors = (found.pos + found.rot).clip(max=LOST).mean(-1)
    out = (errors * weight).sum(-1) / weight.sum()
    touch = problem.touch[first : first + steps]
    off = np.linalg.norm(trial.tips - problem.ref_tips[first : first + steps], axis=-1)
    off = (off - TIP_SLACK).clip(0, TIP_MAX) / limits.pos * touch
    count = touch.sum((-1, -2)).clip(1)
    out += config.tip_weight * (off.sum((-1, -2)) / count).mean(-1)
    out = out.mean(-1)
    out += config.residual_weight * (knots**2).mean((-1, -2, -3))
    if knots.shape[1] > 1:
        jumps = np.diff(knots, axis=1) / np.maximum(noise, 1e-9)
        out += config.smooth_weight * (jumps**2).mean((-1, -2, -3))
    return Costs(out, found.worst.mean((-1, -2)))
