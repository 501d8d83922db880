"""``report.html`` of a motion library: one page without any outside address."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.reports.library.cards import motion_card
from flashdex.reports.library.facts import (
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
from flashdex.reports.library.table import SCRIPT, code_table, recordings_table
from flashdex.reports.library.table import STYLE as TABLE_STYLE
from flashdex.reports.page import (
    Html,
    Series,
    duration,
    facts,
    joined,
    line_chart,
    nice_ticks,
    number,
    page,
    table,
    tag,
)
from flashdex.reports.render.stills import draw_thumbnails
from flashdex.reports.run.terminal import MAX_WIDTH, align, plain, shorten
from flashdex.system.files import write_atomic

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
    parts = [[headline(facts)], _list_sources(facts), _codes(facts), _worst(facts)]
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
    cells = [["worst motions", "status", *FIGURES, "codes"]]
    for one in worst:
        values = [plain(one.value(column)) for column in FIGURES.values()]
        codes = " ".join(one.codes)
        cells.append([shorten(one.name, NAME_WIDTH), one.status, *values, codes])
    return [*align(cells, left=(0, 1, len(cells[0]) - 1)), *LEGEND.splitlines()]


def _printable(text: str) -> str:
    """Without control characters: a name must not steer the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


__all__ = ["summary_lines", "write_library_report"]

REPORT = "report.html"
MAX_CARDS = 150  # a page of 2,000 cards would not open
NUM_BINS = 20
CHARTS = {
    "tip_error_median_mm": ("median fingertip error", "mm"),
    "tip_error_p95_mm": ("p95 fingertip error", "mm"),
    "penetration_p95_mm": ("p95 depth in objects", "mm"),
    "seconds": ("length", "s"),
}
STYLE = """
.warn { color: #8a5a00; }
.card { border-top: 1px solid #ccc; padding: 2px 0 14px; content-visibility: auto;
  contain-intrinsic-size: auto 560px; }
.card .charts { grid-template-columns: repeat(auto-fit, minmax(min(100%, 270px), 1fr));
  margin-top: 10px; }
.card svg { font-size: 14px; } .card svg .t { font-size: 15px; }
.four { display: grid; grid-template-columns: repeat(4, 1fr); }
"""


def write_library_report(
    library: MotionLibrary,
    path: Path | None = None,
    *,
    thumbnails: bool = True,
    max_cards: int = MAX_CARDS,
) -> Path:
    """Write ``report.html``: what was kept, what was not and why, and how good it is.

    Args:
        library: the prepared collection.
        path: the page; by default ``report.html`` in the library.
        thumbnails: draw stills of the motions that have a card.
        max_cards: motions with a card, flagged ones and the worst first; the table has
            all recordings in any case.

    Returns:
        The page.

    Raises:
        LibraryError: ``report.csv`` is not a table, or the page cannot be written.

    Example:
        >>> library = MotionLibrary.load("libraries/mine")  # doctest: +SKIP
        >>> write_library_report(library)  # doctest: +SKIP
        PosixPath('libraries/mine/report.html')
    """
    path = library.path / REPORT if path is None else path
    recordings = library_facts(library)
    inside = [(one, one.row) for one in recordings if one.row is not None]
    carded = inside[:max_cards]
    rows = [row for _, row in carded]
    stills, fault = draw_thumbnails(library, rows) if thumbnails else ({}, "")
    sections = [
        tag("style", Html(TABLE_STYLE + STYLE)),
        *_head(library, recordings),
        tag("h2", "Reasons"),
        code_table(recordings),
        tag("h2", "Distributions"),
        _distributions(recordings),
        tag("h2", "Recordings"),
        _table_note(recordings),
        recordings_table(recordings, cards=set(rows)),
        tag("h2", "Motions"),
        _card_note(library, len(carded), fault),
        *(motion_card(library, one, stills=stills.get(row)) for one, row in carded),
        tag("script", Html(SCRIPT)),
    ]
    text = page(f"{_name(library)}: flashdex library", sections)
    # half of a surrogate pair in a name is no character and cannot be written
    text = text.encode("utf-8", errors="replace").decode("utf-8")
    try:
        write_atomic(path, text)
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror}).") from error
    return path


def _name(library: MotionLibrary) -> str:
    return library.path.resolve().name


def _head(library: MotionLibrary, recordings: Sequence[RecordingFacts]) -> list[Html]:
    versions = library.manifest.get("versions") or {}
    told = facts(
        [
            ("hand", library.hand),
            ("rate", f"{library.fps:g} Hz"),
            ("motions", f"{library.num_motions:,}"),
            ("frames", f"{len(library.frames):,}"),
            ("objects", f"{len(library.objects):,}"),
            ("motion", duration(len(library.frames) / library.fps)),
            ("versions", ", ".join(f"{k} {v}" for k, v in dict(versions).items())),
        ]
    )
    total = len(recordings)
    boxes = [
        tag("div", tag("b", f"{count:,}/{total:,}"), status)
        for status, count in count_statuses(recordings).items()
    ]
    seconds = len(library.frames) / library.fps
    boxes.append(tag("div", tag("b", f"{seconds:,.0f}"), "seconds of motion"))
    return [
        tag("h1", _name(library)),
        told,
        tag("div", *boxes, class_="numbers"),
        _sources(recordings),
    ]


def _sources(recordings: Sequence[RecordingFacts]) -> Html:
    names = ["source", "licence", "recordings", *reversed(STATUSES), "seconds"]
    rows = []
    for source, group in by_source(recordings).items():
        licences = sorted({one.licence for one in group if one.licence})
        counts = count_statuses(group).values()
        seconds = number(seconds_of(group))
        told = ", ".join(licences) or "not recorded"
        rows.append([source, told, f"{len(group):,}", *counts, seconds])
    return tag("div", table(names, rows), class_="wide")


def _distributions(recordings: Sequence[RecordingFacts]) -> Html:
    charts = [Html(histogram(recordings, column)) for column in CHARTS]
    note = (
        "Motions of the library by figure. The last bin holds all beyond it. Depth in "
        "objects: of the robot hand, whose touching pads are meant to be 2 mm deep."
    )
    grid = tag("div", *charts, class_="charts large")
    return joined([tag("p", note, class_="soft small"), grid])


def histogram(recordings: Sequence[RecordingFacts], column: str) -> str:
    """How many motions of the library have a figure in each of equal bins.

    Args:
        recordings: those without the figure are left out.
        column: of ``report.csv``, one of ``CHARTS``.

    Returns:
        An SVG; the last bin holds all beyond it, so that one wild value does not
        squeeze the others into one bin.
    """
    title, unit = CHARTS[column]
    found = {s: _values(recordings, column, s) for s in ("kept", "flagged")}
    values = np.concatenate(list(found.values()))
    if not len(values):
        return line_chart([], title=title, x_label=unit)
    top = float(min(values.max(), 3 * np.quantile(values, 0.9)))
    edges = np.array(nice_ticks(0.0, top, count=NUM_BINS))
    series = []
    for status, some in found.items():
        counts, _ = np.histogram(some.clip(edges[0], edges[-1]), edges)
        if counts.any():
            x = [edges[0], *edges]
            series.append(Series(status, x, [0, *counts.tolist(), 0]))
    median, high = np.quantile(values, [0.5, 0.95])
    label = f"{unit}; median {median:.1f}, p95 {high:.1f}, largest {values.max():.1f}"
    return line_chart(
        series, title=title, x_label=label, is_step=True, y_range=(0.0, 5.0)
    )


def _values(
    recordings: Sequence[RecordingFacts], column: str, status: str
) -> np.ndarray:
    found = [one.value(column) for one in recordings if one.status == status]
    return np.array([value for value in found if value is not None], dtype=float)


def _table_note(recordings: Sequence[RecordingFacts]) -> Html:
    text = (
        f"All {len(recordings):,} recordings, rejected ones first, then flagged ones, "
        "in each the worst first: by the largest of p95 fingertip error over 40 mm, "
        "depth in objects over 20 mm and depth of human tips over 10 mm. A heading "
        "sorts by its column, a code above shows its recordings. Columns: docs/data.md."
    )
    return tag("p", text, class_="soft small")


def _card_note(library: MotionLibrary, shown: int, fault: str) -> Html:
    total = library.num_motions
    text = f"All {total:,} motions of the library, flagged and worst first."
    if shown < total:
        text = (
            f"The {shown:,} flagged or worst of {total:,} motions of the library; the "
            "table above has them all."
        )
    if library.quality is None:
        text += " Errors over time were not stored: prepare the library again."
    notes = [tag("p", text, class_="soft small")]
    if fault:
        notes.append(tag("p", f"{fault}.", class_="bad"))
    return joined(notes)
