"""From verdicts of rollouts to numbers of a collection: rates, MOPE, MORE."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from flashdex.metrics.criteria_table import State, Verdict
from flashdex.metrics.errors import TrackingErrors


@dataclass(frozen=True)
class Rate:
    """Passed over passed and failed; what was not measured is shown, never counted.

    Example:
        >>> str(Rate(43, 7, 0))
        '43/50 (0 n.m.)'
    """

    passed: int = 0
    failed: int = 0
    not_measured: int = 0

    @classmethod
    def of(cls, states: Iterable[State]) -> Rate:
        """Count states, one a motion."""
        counts = Counter(states)
        return cls(counts["passed"], counts["failed"], counts["not_measured"])

    @property
    def measured(self) -> int:
        """Denominator."""
        return self.passed + self.failed

    @property
    def value(self) -> float | None:
        """The rate, or None when nothing was measured."""
        return self.passed / self.measured if self.measured else None

    def __str__(self) -> str:
        return f"{self.passed}/{self.measured} ({self.not_measured} n.m.)"


def rates(scores: Iterable[Mapping[str, Verdict]]) -> dict[str, Rate]:
    """Rate of every criterion over a collection, of the ``score`` of each motion."""
    listed = list(scores)
    names = dict.fromkeys(name for one in listed for name in one)
    return {
        name: Rate.of(one[name].state for one in listed if name in one)
        for name in names
    }


@dataclass(frozen=True)
class MeanErrors:
    """Mean object errors of one motion, over frames and hands' objects."""

    pos: float  # m
    rot: float  # rad


def mean_object_errors(errors: TrackingErrors, *, grace: int = 0) -> MeanErrors | None:
    """Mean object errors of one rollout; None if they cannot be measured.

    A shared object counts once per hand, as everywhere; the first ``grace`` steps are
    left out.
    """
    pos, rot = errors.object_pos_error, errors.object_rot_error
    if pos is None or rot is None or not errors.slots or not errors.is_finite:
        return None
    if errors.num_frames <= grace:
        return None
    pos, rot = (error[grace:, errors.slots].mean() for error in (pos, rot))
    return MeanErrors(float(pos), float(rot))


def mope_more(
    motions: Iterable[tuple[MeanErrors | None, Verdict]],
) -> dict[str, float | int | None]:
    """Mean over motions that pass SR_SPIDER, and over all attempted motions.

    The first pair is the paper's; its filter rewards methods that fail on hard clips,
    hence the second.

    Args:
        motions: errors of each motion with its ``sr_spider_centred`` verdict.

    Returns:
        ``mope`` and ``mope_all`` in mm, ``more`` and ``more_all`` in rad, None without
        motions; ``mope_motions`` and ``mope_all_motions`` say how many entered.
    """
    measured = [(errors, v) for errors, v in motions if errors is not None]
    passing = [errors for errors, v in measured if v.is_passed]
    every = [errors for errors, _ in measured]
    return {
        "mope": _mean([e.pos * 1e3 for e in passing]),
        "more": _mean([e.rot for e in passing]),
        "mope_all": _mean([e.pos * 1e3 for e in every]),
        "more_all": _mean([e.rot for e in every]),
        "mope_motions": len(passing),
        "mope_all_motions": len(every),
    }


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
