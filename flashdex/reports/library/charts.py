"""Charts of a library: figures of all motions, and one motion over its time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from flashdex.datasets.tracks import runs
from flashdex.keys import FINGERS, SIDES
from flashdex.motions.library import MotionLibrary
from flashdex.reports.chart import (
    BOTTOM,
    COLOURS,
    HEIGHT,
    TOP,
    Axis,
    Series,
    draw_chart,
    line_chart,
    nice_ticks,
    stretches,
)
from flashdex.reports.library.facts import RecordingFacts
from flashdex.reports.render.stills import contact_of, frames_of
from flashdex.reports.text import shorten

NUM_BINS = 20
FIGURES = {
    "tip_error_median_mm": ("median fingertip error", "mm"),
    "tip_error_p95_mm": ("p95 fingertip error", "mm"),
    "penetration_p95_mm": ("p95 depth in objects", "mm"),
    "seconds": ("length", "s"),
}
OBJECT_NAME = 10  # characters of it in a legend
BAR_GAP = 1.5  # pixels above and below a bar


def histogram(recordings: Sequence[RecordingFacts], column: str) -> Markup:
    """How many motions of the library have one of ``FIGURES`` in each of equal bins.

    The last bin holds all beyond it, so that one wild value does not squeeze the
    others into one bin.
    """
    title, unit = FIGURES[column]
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
) -> NDArray[np.floating]:
    found = [one.value(column) for one in recordings if one.status == status]
    return np.array([value for value in found if value is not None], dtype=float)


def motion_charts(library: MotionLibrary, row: int) -> list[Markup]:
    """Charts of one motion over its time; without ``quality`` two are left out."""
    charts = []
    if library.quality is not None:
        quality = library.quality[frames_of(library, row)]
        tips = 1e3 * quality["tip_error"].double().numpy().max(axis=2)
        depth = 1e3 * quality["penetration"].double().numpy()
        active = library.motions["hand_active"][row].nonzero()[:, 0].tolist()
        sides = {SIDES[hand]: tips[:, hand] for hand in active}
        charts = [
            _peak_chart("worst tip error", sides, library.fps),
            _peak_chart("hand in objects", {"": depth}, library.fps),
        ]
    contact = contact_of(library, row)
    return [
        *charts,
        contact_timeline(contact, fps=library.fps),
        _height_chart(library, row),
    ]


def _peak_chart(
    title: str, curves: dict[str, NDArray[np.floating]], fps: float
) -> Markup:
    """Largest values, mm, of equal stretches: the mean would hide a short fault."""
    series = []
    for name, values in curves.items():
        parts = stretches(len(values))
        highest = [float(values[part].max()) for part in parts]
        series.append(Series(name, [part.start / fps for part in parts], highest))
    return line_chart(series, title=title, x_label="s", y_label="mm", y_range=(0, 5))


def contact_timeline(contact: NDArray[np.bool_], *, fps: float) -> Markup:
    """Ten rows of bars: when each finger of each hand touches, (T, 2, 5), as SVG."""
    axis = Axis.horizontal(0.0, max(len(contact) - 1, 1) / fps)
    height = (HEIGHT - TOP - BOTTOM) / (len(SIDES) * len(FINGERS))
    rows, bars = [], []
    for hand, side in enumerate(SIDES):
        for finger, name in enumerate(FINGERS):
            top = TOP + (hand * len(FINGERS) + finger) * height
            rows.append((top + 0.75 * height, f"{side[0].upper()} {name}"))
            for span in runs(contact[:, hand, finger]):
                left, right = (axis.at(min(t / fps, axis.high)) for t in span)
                wide, high = max(right - left, 1.0), height - 2 * BAR_GAP
                bars.append((left, top + BAR_GAP, wide, high, COLOURS[hand]))
    between = [TOP + len(FINGERS) * height]
    title = "human fingers in contact"
    return draw_chart(title, axis, x_label="s", rows=rows, bars=bars, grid=between)


def _height_chart(library: MotionLibrary, row: int) -> Markup:
    rows = [r for r in library.motions["object_index"][row].tolist() if r >= 0]
    height = library.frames["object_pos"][frames_of(library, row)][..., 2]
    times = [t / library.fps for t in range(len(height))]
    names = [str(library.manifest["objects"][r]["name"]) for r in rows]
    series = [
        Series(shorten(name, OBJECT_NAME), times, (100 * height[:, slot]).tolist())
        for slot, name in enumerate(names)
    ]
    return line_chart(series, title="object height", x_label="s", y_label="cm")
