"""What a prepared library has come to, for the terminal, at most 100 columns wide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from flashdex.motions.library import MotionLibrary
from flashdex.viz.html import duration
from flashdex.viz.library_facts import (
    CODES,
    STATUSES,
    RecordingFacts,
    by_source,
    count_codes,
    count_statuses,
    facts_of_rows,
    library_facts,
    seconds_of,
)
from flashdex.viz.table import MAX_WIDTH, align, plain, shorten

NUM_WORST = 5
NAME_WIDTH = 36
COUNTED = tuple(reversed(STATUSES))  # kept, flagged, rejected
FIGURES = {
    "median": "tip_error_median_mm",
    "p95": "tip_error_p95_mm",
    "depth": "penetration_max_mm",
    "human": "human_tip_depth_mm",
}
LEGEND = (
    "mm; median, p95: robot tips off human tips; depth: robot hand in an object, at "
    "most;\nhuman: human tips in it. Worst: largest share of what flags a motion."
)


def summary_lines(library: MotionLibrary | Iterable[Mapping[str, Any]]) -> list[str]:
    """Totals by source, recordings by code, and the five worst motions.

    Args:
        library: a prepared collection, or rows as ``report.csv`` has them.

    Returns:
        Lines of printable characters only: names come from untrusted files.

    Raises:
        LibraryError: ``report.csv`` of the library is not a table.

    Example:
        >>> row = {"motion": "lift", "status": "kept", "seconds": 2.0}
        >>> summary_lines([row])[0]
        '1 recording: 1 kept, 0 flagged, 0 rejected; 0 min 02 s of motion'
    """
    is_library = isinstance(library, MotionLibrary)
    facts = library_facts(library) if is_library else facts_of_rows(library)
    parts = [[headline(facts)], _sources(facts), _codes(facts), _worst(facts)]
    lines = [line for part in parts if part for line in [*part, ""]]
    return [_printable(line)[:MAX_WIDTH].rstrip() for line in lines[:-1]]


def headline(facts: Sequence[RecordingFacts]) -> str:
    """Counts by status and seconds of motion, in one line.

    Args:
        facts: recordings.
    """
    counts = ", ".join(f"{n} {status}" for status, n in count_statuses(facts).items())
    noun = "recording" if len(facts) == 1 else "recordings"
    return f"{len(facts)} {noun}: {counts}; {duration(seconds_of(facts))} of motion"


def _sources(facts: Sequence[RecordingFacts]) -> list[str]:
    cells = [["source", *COUNTED, "seconds"]]
    for source, group in by_source(facts).items():
        counts = [str(n) for n in count_statuses(group).values()]
        seconds = plain(seconds_of(group))
        cells.append([shorten(source, NAME_WIDTH), *counts, seconds])
    return align(cells)


def _codes(facts: Sequence[RecordingFacts]) -> list[str]:
    counts = count_codes(facts)
    if not counts:
        return []
    cells = [["code", *COUNTED, "meaning"]]
    for code, by_status in counts.items():
        meaning = CODES.get(code, "")
        cells.append([shorten(code, 16), *map(str, by_status.values()), meaning])
    return align(cells, left=(0, len(COUNTED) + 1))


def _worst(facts: Sequence[RecordingFacts]) -> list[str]:
    inside = [one for one in facts if one.status != "rejected" and one.badness > 0]
    worst = sorted(inside, key=lambda one: -one.badness)[:NUM_WORST]
    if not worst:
        return []
    cells = [["worst motions", "status", *FIGURES, "codes"]]
    for one in worst:
        values = [plain(one.value(column)) for column in FIGURES.values()]
        codes = " ".join(one.codes)
        cells.append([shorten(one.name, NAME_WIDTH), one.status, *values, codes])
    return [*align(cells, left=(0, 1, len(cells[0]) - 1)), *LEGEND.splitlines()]


def _printable(text: str) -> str:
    """Without control characters: a name must not steer the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)
