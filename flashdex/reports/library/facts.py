"""What the reports of a library show: every recording, its codes, and how bad it is."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flashdex.errors import LibraryError
from flashdex.motions.checks.aligned import IK_P95, REFERENCE_DEPTH, TIP_DEPTH
from flashdex.motions.library import MotionLibrary
from flashdex.system.files import open_plain

MAX_REPORT = 256 << 20  # bytes of report.csv that are read
STATUSES = ("rejected", "flagged", "kept")
# mm, from which on a figure flags a motion: W_IK, W_DEPTH, W_PEN
LIMITS = {
    "tip_error_p95_mm": 1e3 * IK_P95,
    "penetration_max_mm": 1e3 * REFERENCE_DEPTH,
    "human_tip_depth_mm": 1e3 * TIP_DEPTH[0],
}
# docs/data.md says the same at more length; a test compares the codes
CODES = {
    "E_CRASH": "preparing it ended in an unforeseen fault",
    "E_DEMO": "unusable otherwise: NaN, quaternions, too few frames",
    "E_FILE": "files that belong together are missing",
    "E_KEYS": "a key is missing or has a wrong shape",
    "E_LEN": "hands and objects have different numbers of frames",
    "E_MACHINE": "memory or a disk failed; the same command tries it again",
    "E_MANO": "MANO files missing, wrong, or sides swapped",
    "E_MESH": "mesh missing, unreadable or without volume",
    "E_NAN": "frames not tracked: filled, cut around, or too many",
    "E_PICKLE": "the file asks for code to be run; it is not read",
    "E_READ": "the recording cannot be read",
    "E_ROOT": "expected folders are absent",
    "E_ROT": "not a rotation",
    "E_UNIT": "palm, object or reach of a wrong size: metres?",
    "I_DUP": "the same content as another recording",
    "I_OBJECTS": "objects that nobody touches, or without a slot, are left out",
    "W_OBJECTS": "an object that moves was left out: two at most",
    "I_SIGN": "quaternion signs that flipped were set right",
    "R_BELOW": "object more than 5 cm below the table",
    "W_HELD": "every frame stands several times: another rate",
    "W_ORIGIN": "a mesh far from the origin of its frame was moved there",
    "E_SIDE": "fingers bend backwards: left and right swapped, or mirrored",
    "R_CONTACT": "the object moves, but no fingertip comes within 2 cm",
    "R_INACTIVE": "no hand touches an object, at all or for a time",
    "R_LONG": "over 20 s: cut it",
    "R_SHORT": "under 1 s",
    "W_ALONE": "an object moves while its hand is elsewhere: other clocks?",
    "W_ACCEL": "wrist accelerates with more than 60 m/s2",
    "W_DEPTH": "robot hand over 20 mm inside an object, or in the table",
    "W_FPS": "measured rate differs from the announced one",
    "W_GAP": "frames are missing",
    "W_HULL": "the convex hull is far larger than the mesh",
    "W_IK": "robot tips far off the human's, or joints at their limits",
    "W_JUMP": "hand or object jumps",
    "W_MISSHAND": "a hand is missing for much of the motion",
    "W_OBJOBJ": "objects inside each other at the first frame",
    "W_PARTS": "too many convex parts",
    "W_PEN": "human fingertip over 10 mm inside the object",
    "W_SHAPE": "no hand shape: an average hand is used",
    "W_STATIC": "touched, but no object moves",
    "W_SUPPORT": "nothing rests, or an object rests below the table",
    "W_SYM": "the object is rotationally symmetric",
    "W_UP": "the up axis looks wrong",
    "W_WATER": "mesh not watertight",
}
_CODE = re.compile(r"(?:^|; )([A-Z]_[A-Z0-9]+): ")


@dataclass(frozen=True)
class RecordingFacts:
    """One row of ``report.csv``.

    Names and reasons come from the files that were read: show them escaped only.
    """

    name: str  # of the motion
    status: str  # one of ``STATUSES``
    reason: str  # codes with their text
    # every other column, as written
    figures: Mapping[str, str] = field(default_factory=dict)
    row: int | None = None  # of the library, None when it is not in it
    source: str = ""  # dataset
    licence: str = ""  # of the dataset, empty when not known

    @property
    def codes(self) -> list[str]:
        """Codes of the reason, each once."""
        return list(dict.fromkeys(_CODE.findall(self.reason)))

    @property
    def badness(self) -> float:
        """Largest figure in units of the limit beyond which it flags a motion."""
        found = [(self.value(column), limit) for column, limit in LIMITS.items()]
        return max((v / limit for v, limit in found if v is not None), default=0.0)

    def value(self, column: str) -> float | None:
        """A column as a number; None when it is not there or not finite."""
        try:
            value = float(self.figures.get(column, ""))
        except ValueError:
            return None
        return value if math.isfinite(value) else None


def library_facts(library: MotionLibrary) -> list[RecordingFacts]:
    """Every recording of a library, rejected ones too, the worst first.

    Rejected recordings are only in ``report.csv``; a motion that it does not name is
    taken from the manifest.

    Raises:
        LibraryError: ``report.csv`` is not a table.
    """
    # a library of several sources has a list here, which says nothing about one motion
    source = library.manifest.get("source", "")
    source = source if isinstance(source, str) else ""
    motions = {m["name"]: (row, m) for row, m in enumerate(library.manifest["motions"])}
    facts = []
    for line in _read_report(library.path / "report.csv"):
        row, info = None, {}
        if line.get("status") != "rejected":
            row, info = motions.pop(line.get("motion", ""), (row, info))
        facts.append(_make(line, info, row, source))
    for name, (row, info) in motions.items():
        line = {"motion": name, "status": "kept"}
        line |= {k: str(info[k]) for k in ("status", "reason") if k in info}
        line["seconds"] = f"{int(library.motions['length'][row]) / library.fps:.3f}"
        facts.append(_make(line, info, row, source))
    return worst_first(facts)


def facts_of_rows(rows: Iterable[Mapping[str, Any]]) -> list[RecordingFacts]:
    """The same of rows that ``prepare`` has made: columns of ``report.csv`` by name."""
    lines = [{k: str(v) for k, v in row.items() if v is not None} for row in rows]
    return worst_first([_make(line, {}, None, "") for line in lines])


def worst_first(facts: Iterable[RecordingFacts]) -> list[RecordingFacts]:
    """Rejected before flagged before kept; within each the worst figure first."""

    def place(one: RecordingFacts) -> tuple[int, float]:
        known = one.status in STATUSES
        return STATUSES.index(one.status) if known else len(STATUSES), -one.badness

    return sorted(facts, key=place)


def columns_of(facts: Sequence[RecordingFacts]) -> list[str]:
    """Columns of ``report.csv`` besides motion, status and reason, in order."""
    # a rejected recording may have fewer columns
    longest = sorted(facts, key=lambda one: -len(one.figures))
    return list(dict.fromkeys(column for one in longest for column in one.figures))


def count_statuses(facts: Iterable[RecordingFacts]) -> dict[str, int]:
    """Number of recordings of each status, every status named."""
    counts = Counter(one.status for one in facts)
    return {status: counts[status] for status in reversed(STATUSES)}


def count_codes(facts: Sequence[RecordingFacts]) -> dict[str, dict[str, int]]:
    """Recordings of each status by code, the most frequent code first.

    A code counts once in each recording.
    """
    totals = Counter(code for one in facts for code in one.codes)
    return {
        code: count_statuses(one for one in facts if code in one.codes)
        for code, _ in totals.most_common()
    }


def by_source(facts: Iterable[RecordingFacts]) -> dict[str, list[RecordingFacts]]:
    """Recordings by source, the largest first."""
    groups: dict[str, list[RecordingFacts]] = {}
    for one in facts:
        groups.setdefault(one.source or "not recorded", []).append(one)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


def seconds_of(facts: Iterable[RecordingFacts]) -> float:
    """Seconds of the motions that are not rejected."""
    inside = (one for one in facts if one.status != "rejected")
    return sum(one.value("seconds") or 0.0 for one in inside)


def _make(
    line: Mapping[str, str], info: Mapping[str, Any], row: int | None, source: str
) -> RecordingFacts:
    own = ("motion", "status", "reason")
    return RecordingFacts(
        name=line.get("motion", ""),
        status=line.get("status", ""),
        reason=line.get("reason", ""),
        figures={k: v for k, v in line.items() if k not in own},
        row=row,
        source=str(line.get("source") or info.get("source") or source),
        licence=str(info.get("licence") or line.get("licence") or ""),
    )


def _read_report(path: Path) -> list[dict[str, str]]:
    try:
        with open_plain(path) as file:
            text = file.read(MAX_REPORT).decode("utf-8", errors="replace")
        table = io.StringIO(text, newline="")
        lines = list(csv.DictReader(table, restkey="", restval=""))
    except FileNotFoundError:
        return []
    except (OSError, csv.Error) as error:
        raise LibraryError(
            f"{path}: not a readable table ({error}). Prepare the library again."
        ) from error
    # cells beyond the heading have no name and are left out
    return [{k: v for k, v in line.items() if k} for line in lines]
