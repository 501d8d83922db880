"""``report.html`` of a motion library, and the same in short for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import as_library_error
from flashdex.reports.library.charts import FIGURES, histogram, motion_charts
from flashdex.reports.library.facts import (
    CODES,
    STATUSES,
    RecordingFacts,
    by_source,
    columns_of,
    count_codes,
    count_statuses,
    facts_of_rows,
    library_facts,
    seconds_of,
)
from flashdex.reports.page import write_page
from flashdex.reports.render.stills import draw_thumbnails, still_frames
from flashdex.reports.text import MAX_WIDTH, align, duration, plain, shorten
from flashdex.system.files import own_file

REPORT = "report.html"
MAX_CARDS = 150  # a page of 2,000 cards would not open
MAX_REASON = 600  # characters of a cell; report.csv has all of them
COUNTED = list(reversed(STATUSES))  # kept, flagged, rejected


def write_library_report(
    library: MotionLibrary,
    path: Path | None = None,
    *,
    thumbnails: bool = True,
    max_cards: int = MAX_CARDS,
) -> Path:
    """Write ``report.html``: what was kept, what was not and why, and how good it is.

    The page is ``report.html`` in the library by default. At most ``max_cards`` motions
    have a card, flagged ones and the worst first, with stills when ``thumbnails`` says
    so; the table has all recordings in any case.

    Raises:
        LibraryError: ``report.csv`` is not a table, or the page cannot be written.
    """
    if path is None:
        with as_library_error(hint=""):
            path = own_file(library.path, REPORT)
    recordings = library_facts(library)
    inside = {one.row: one for one in recordings if one.row is not None}
    rows = list(inside)[:max_cards]
    stills, fault = draw_thumbnails(library, rows) if thumbnails else ({}, "")
    return write_page(
        path,
        "library.html",
        error=LibraryError,
        name=library.path.resolve().name,
        library=library,
        versions=library.manifest.get("versions") or {},
        motion_s=len(library.frames) / library.fps,
        counts=count_statuses(recordings),
        sources=by_source(recordings),
        count_statuses=count_statuses,
        seconds_of=seconds_of,
        codes=count_codes(recordings),
        meanings=CODES,
        histograms=[histogram(recordings, column) for column in FIGURES],
        recordings=recordings,
        columns=columns_of(recordings),
        max_reason=MAX_REASON,
        carded=set(rows),
        cards=[_card(library, row, inside[row], stills.get(row)) for row in rows],
        fault=fault,
    )


def _card(
    library: MotionLibrary, row: int, one: RecordingFacts, stills: bytes | None
) -> dict[str, Any]:
    """Everything to judge one motion by."""
    frames = still_frames(library, row).items()
    return {
        "one": one,
        "stills": stills,
        "moments": {word: frame / library.fps for word, frame in frames},
        "charts": motion_charts(library, row),
    }


NUM_WORST = 5
NAME_WIDTH = 36
WORST = {
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

    Of a prepared collection, or of rows as ``report.csv`` has them. All characters are
    printable: names come from untrusted files.

    Raises:
        LibraryError: ``report.csv`` of the library is not a table.

    Example:
        >>> row = {"motion": "lift", "status": "kept", "seconds": 2.0}
        >>> summary_lines([row])[0]
        '1 recording: 1 kept, 0 flagged, 0 rejected; 0 min 02 s of motion'
    """
    is_library = isinstance(library, MotionLibrary)
    facts = library_facts(library) if is_library else facts_of_rows(library)
    parts = [[_headline(facts)], _list_sources(facts), _codes(facts), _worst(facts)]
    lines = [line for part in parts if part for line in [*part, ""]]
    return [_printable(line)[:MAX_WIDTH].rstrip() for line in lines[:-1]]


def _headline(facts: Sequence[RecordingFacts]) -> str:
    counts = ", ".join(f"{n} {status}" for status, n in count_statuses(facts).items())
    noun = "recording" if len(facts) == 1 else "recordings"
    return f"{len(facts)} {noun}: {counts}; {duration(seconds_of(facts))} of motion"


def _list_sources(facts: Sequence[RecordingFacts]) -> list[str]:
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
    cells = [["worst motions", "status", *WORST, "codes"]]
    for one in worst:
        values = [plain(one.value(column)) for column in WORST.values()]
        codes = " ".join(one.codes)
        cells.append([shorten(one.name, NAME_WIDTH), one.status, *values, codes])
    return [*align(cells, left=(0, 1, len(cells[0]) - 1)), *LEGEND.splitlines()]


def _printable(text: str) -> str:
    """Without control characters: a name must not steer the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)
