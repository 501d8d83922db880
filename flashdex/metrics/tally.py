"""What the lines of a ledger come to: conversions, proofs, and what is trivial."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from flashdex.metrics.criteria_table import limits_of

SPEED = "convert/per_hour"  # of a clock that went on between two readings
SPEED_TOLERANCE = 0.05
UNMOVED = "moves_too_little"  # reason for a trivial conversion, beside baselines
# of a motion's first pass, what a better proof of a later one replaces
NEWEST = ("certified", "verdict", "survived", "rollout_sha256", "certificate_sha256")

NEARER = 0.9  # of its distance an attempt may have to replace a nearest miss

Line = dict[str, Any]


def is_trivial(line: Line) -> bool:
    """A conversion that needed no learning, or in which the object hardly moved."""
    return bool(line.get("trivial"))


def is_unmoved(line: Line) -> bool:
    """A pass in which an object stays behind its reference."""
    return UNMOVED in (line.get("trivial") or ())


def miss_distance(line: Line) -> tuple[bool, bool, float]:
    """How far an attempt is from a pass; the smallest is the nearest.

    An object that moves comes before one that hardly does, a whole attempt before one
    that was cut short. Whole ones differ by their worst error as a share of its limit,
    the others by how soon they ended.
    """
    limits, errors = limits_of(line["criterion"], 0), line["errors"]
    shares = [
        value / limits[name]
        for name, value in errors.items()
        if name in limits and name not in ("lift", "path")
    ]
    is_whole = line["completed"] and bool(shares)
    size = max(shares) if is_whole else 1 / max(1, line["frame"])
    is_finite = all(map(math.isfinite, shares))
    return is_unmoved(line), not is_whole, size if is_finite else math.inf


def is_nearer(line: Line, before: Line | None) -> bool:
    """Whether an attempt replaces a nearest miss: by a tenth at least, to write less.

    One that diverged never does.
    """
    *kind, size = miss_distance(line)
    if before is None:
        return size < math.inf
    *kind_before, size_before = miss_distance(before)
    return (kind, size) < (kind_before, NEARER * size_before)


def follow_misses(misses: dict[str, Line], line: Line) -> None:
    """Take a line of a ledger into the lines that name the nearest misses, by motion.

    A miss is kept until a nearer one comes, or a pass in which the object moves.
    """
    if line.get("miss"):
        misses[line["motion"]] = line
    elif line.get("rollout") and not is_unmoved(line):
        misses.pop(line["motion"], None)


class Tally:
    """Counts of attempts, from their lines.

    Args:
        names: of the motions of the run.
        criterion: of the run; lines of another one do not count.
        lines: to count, oldest first.
    """

    def __init__(
        self, names: Iterable[str], criterion: str, lines: Iterable[Line] = ()
    ) -> None:
        self.names, self.criterion = list(names), criterion
        # motion -> line of its first pass, with the newest verdict
        self.conversions: dict[str, Line] = {}
        self.last: dict[str, bool] = {}  # motion -> whether its newest attempt passed
        self.misses: dict[str, Line] = {}  # motion -> line of its nearest miss
        # motion -> lines
        self.attempts: dict[str, int] = dict.fromkeys(self.names, 0)
        for line in lines:  # a resume may ask for another criterion, or fewer motions
            if line["criterion"] == criterion and line["motion"] in self.attempts:
                self.count(line)

    def count(self, line: Line) -> bool:
        """Count a line that is in the file; is the motion done by it?"""
        name = line["motion"]
        follow_misses(self.misses, line)
        self.attempts[name] = self.attempts.get(name, 0) + 1
        self.last[name] = line["converted"]
        before, was_done = self.conversions.get(name), self.is_done(name)
        if before is None or self.moves_more(line, before):
            if line["converted"]:
                self.conversions[name] = dict(line)
        elif line.get("verdict") is not None and not self.moves_more(before, line):
            newest = {key: line.get(key) for key in NEWEST}
            before.update(newest)
        return self.is_done(name) and not was_done

    @staticmethod
    def moves_more(line: Line, before: Line) -> bool:
        """A pass in which the object moves, against one in which it hardly did."""
        return is_unmoved(before) and not is_unmoved(line)

    @property
    def note(self) -> str:
        """What was achieved, in a few words: what is not trivial first."""
        text = f"{self.num_converted} of {len(self.names)} converted"
        if self.num_converted:
            text += f", {self.num_certified} certified"
        return f"{text}, and {self.num_trivial} trivial" if self.num_trivial else text

    @property
    def num_attempts(self) -> int:
        """Attempts of all motions."""
        return sum(self.attempts.values())

    @property
    def num_passed(self) -> int:
        """Motions with at least one passing attempt, trivial ones too."""
        return len(self.conversions)

    def is_done(self, name: str) -> bool:
        """Has the motion a passing attempt in which the object moves as it should?"""
        return name in self.conversions and not is_unmoved(self.conversions[name])

    @property
    def done(self) -> list[str]:
        """Motions of which no further attempt is needed."""
        return [name for name in self.conversions if self.is_done(name)]

    @property
    def _earned(self) -> list[Line]:
        return [c for c in self.conversions.values() if not is_trivial(c)]

    @property
    def num_converted(self) -> int:
        """Motions with a passing attempt that is not trivial."""
        return len(self._earned)

    @property
    def num_trivial(self) -> int:
        """Motions whose passing attempt is trivial."""
        return self.num_passed - self.num_converted

    @property
    def num_certified(self) -> int:
        """Converted motions, not trivial, whose certificate holds."""
        return sum(bool(c["certified"]) for c in self._earned)

    def metrics(self, hours: float) -> dict[str, float]:
        """Counters of the ``convert/`` group after so many hours of wall time."""
        total = len(self.names)
        passing = sum(self.last.get(n, False) for n in self.names)
        robust = sum(c.get("verdict") == "robust" for c in self._earned)
        out = {
            "convert/nontrivial": float(self.num_converted),
            "convert/trivial": float(self.num_trivial),
            "convert/cumulative": float(self.num_passed),
            "convert/rate": self.num_passed / total,
            "convert/last": passing / total,
            "convert/certified": float(self.num_certified),
            "convert/robust": float(robust),
            "convert/attempts": float(self.num_attempts),
        }
        if hours > 0:
            out["convert/per_hour"] = self.num_converted / hours
        return out


def count_faults(
    records: list[dict[str, Any]],
    lines: list[dict[str, Any]],
    tally: Tally,
    *,
    is_whole: bool,
) -> list[str]:
    """The first record of the metrics that does not count the lines there were.

    ``is_whole``: the last one counts all of them.
    """
    counted = 0
    for number, record in enumerate(records, start=1):
        attempts = record.get("convert/attempts", -1)
        if not counted <= attempts <= len(lines):
            return [f"record {number}: convert/attempts is {attempts:g}"]
        for line in lines[counted : int(attempts)]:
            tally.count(line)
        counted = int(attempts)
        for key, value in tally.metrics(record["hours"]).items():
            slack = SPEED_TOLERANCE if key == SPEED else 0.0
            said = record.get(key, math.nan)
            if not abs(said - value) <= slack * value + 1e-9:
                text = f"record {number}: {key} is {said:g}, by the lines {value:g}"
                return [text]
    if is_whole and counted != len(lines):
        return [f"{counted} attempts are counted of {len(lines)} lines"]
    return []
