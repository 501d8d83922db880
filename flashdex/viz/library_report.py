"""``report.html`` of a motion library: one page without any outside address."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.system.files import write_atomic
from flashdex.viz.html import Html, duration, facts, joined, number, page, table, tag
from flashdex.viz.library_cards import motion_card
from flashdex.viz.library_facts import (
    STATUSES,
    RecordingFacts,
    by_source,
    count_statuses,
    library_facts,
    seconds_of,
)
from flashdex.viz.library_summary import summary_lines
from flashdex.viz.library_table import SCRIPT, code_table, recordings_table
from flashdex.viz.library_table import STYLE as TABLE_STYLE
from flashdex.viz.library_thumbs import draw_thumbnails
from flashdex.viz.plot import Series, line_chart, nice_ticks

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
