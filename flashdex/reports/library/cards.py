"""One card a motion: stills, errors over time, contacts, height of the objects."""

from __future__ import annotations

import base64
import math
from html import escape

import numpy as np
from numpy.typing import NDArray

from flashdex.datasets.tracks import runs
from flashdex.keys import FINGERS, SIDES
from flashdex.motions.library import MotionLibrary
from flashdex.reports.library.facts import RecordingFacts
from flashdex.reports.page import (
    BOTTOM,
    COLOURS,
    HEIGHT,
    LEFT,
    MAX_POINTS,
    RIGHT,
    TOP,
    WIDTH,
    Html,
    Series,
    format_tick,
    line_chart,
    nice_ticks,
    number,
    tag,
)
from flashdex.reports.render.stills import contact_of, frames_of, still_frames
from flashdex.reports.run.terminal import shorten

STATUS_CLASS = {"kept": "good", "flagged": "warn", "rejected": "bad"}
TIME = "s"
OBJECT_NAME = 10  # characters of it in a legend
Floats = NDArray[np.floating]


def motion_card(
    library: MotionLibrary, facts: RecordingFacts, *, stills: bytes | None
) -> Html:
    """Everything to judge one motion by.

    Args:
        library: the prepared collection.
        facts: a recording that is in it.
        stills: JPEG of its pictures side by side, if they could be drawn.

    Raises:
        ValueError: the recording is not in the library.
    """
    row = facts.row
    if row is None:
        raise ValueError(f"{facts.name} is not in the library")
    status = tag("span", facts.status, class_=STATUS_CLASS.get(facts.status, ""))
    parts = [
        tag("h3", facts.name, " ", status, id=card_id(row)),
        tag("p", _words(facts), class_="soft small"),
    ]
    if facts.reason:
        parts.append(tag("p", facts.reason, class_="small"))
    if stills is not None:
        parts.append(_figure(library, row, stills))
    charts = [Html(chart) for chart in motion_charts(library, row)]
    parts.append(tag("div", *charts, class_="charts"))
    return tag("section", *parts, class_="card")


def card_id(row: int) -> str:
    """Where the card of a motion is on the page.

    Args:
        row: of the library.
    """
    return f"motion-{row}"


def motion_charts(library: MotionLibrary, row: int) -> list[str]:
    """Charts of one motion over its time, as SVG.

    Args:
        library: without ``quality`` the first two charts are left out.
        row: motion.
    """
    charts = []
    if library.quality is not None:
        quality = library.quality[frames_of(library, row)]
        error = 1e3 * quality["tip_error"].double().numpy()
        depth = 1e3 * quality["penetration"].double().numpy()
        charts = [_tip_chart(library, row, error), _depth_chart(library, depth)]
    contact = contact_of(library, row)
    return [
        *charts,
        contact_timeline(contact, fps=library.fps),
        _height_chart(library, row),
    ]


def contact_timeline(contact: NDArray[np.bool_], *, fps: float) -> str:
    """Ten rows of bars: when each finger of each hand touches, as SVG.

    Args:
        contact: (T, 2, 5), hands [left, right], fingers thumb to pinky.
        fps: frames a second.
    """
    end = max(len(contact) - 1, 1) / fps
    base, height = HEIGHT - BOTTOM, (HEIGHT - TOP - BOTTOM) / (2 * len(FINGERS))
    out = [_timeline_axis(end)]
    for hand, side in enumerate(SIDES):
        for finger, name in enumerate(FINGERS):
            y = TOP + (hand * len(FINGERS) + finger) * height
            label = f"{side[0].upper()} {name}"
            out.append(
                f'<text x="{LEFT - 5}" y="{y + 0.75 * height:.1f}" '
                f'text-anchor="end" font-size="10">{label}</text>'
            )
            for start, stop in runs(contact[:, hand, finger]):
                left, right = (_place(t / fps, end) for t in (start, stop))
                out.append(
                    f'<rect x="{left:.1f}" y="{y + 1.5:.1f}" '
                    f'width="{max(right - left, 1.0):.1f}" '
                    f'height="{height - 3:.1f}" fill="{COLOURS[hand]}"/>'
                )
    middle = TOP + len(FINGERS) * height
    line = f'x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{middle:.1f}" y2="{middle:.1f}"'
    axis = f'x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{base}" y2="{base}"'
    out.append(f'<line {line} class="g"/><line {axis} class="a"/>')
    name = "human fingers in contact"
    head = (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{name}">'
        f'<text x="{LEFT}" y="16" class="t">{name}</text>'
    )
    return f"{head}{''.join(out)}</svg>"


def _timeline_axis(end: float) -> str:
    base = HEIGHT - BOTTOM
    out = [
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2:.0f}" y="{HEIGHT - 7}" '
        f'text-anchor="middle">{escape(TIME)}</text>'
    ]
    for value in nice_ticks(0.0, end):
        if value <= end:
            x = _place(value, end)
            out.append(
                f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{base}" y2="{base + 4}" '
                f'class="a"/><text x="{x:.1f}" y="{base + 17}" '
                f'text-anchor="middle">{format_tick(value)}</text>'
            )
    return "".join(out)


def _place(seconds: float, end: float) -> float:
    return LEFT + min(seconds / end, 1.0) * (WIDTH - LEFT - RIGHT)


def _tip_chart(library: MotionLibrary, row: int, error: Floats) -> str:
    active = library.motions["hand_active"][row].bool().tolist()
    series = [
        _peaks(side, error[:, hand].max(axis=1), library.fps)
        for hand, side in enumerate(SIDES)
        if active[hand]
    ]
    title = "worst tip error"
    return line_chart(series, title=title, x_label=TIME, y_label="mm", y_range=(0, 5))


def _depth_chart(library: MotionLibrary, depth: Floats) -> str:
    series = [_peaks("", depth, library.fps)]
    title = "hand in objects"
    return line_chart(series, title=title, x_label=TIME, y_label="mm", y_range=(0, 5))


def _height_chart(library: MotionLibrary, row: int) -> str:
    rows = [r for r in library.motions["object_index"][row].tolist() if r >= 0]
    height = library.frames["object_pos"][frames_of(library, row)][..., 2]
    times = [t / library.fps for t in range(len(height))]
    series = [
        Series(_object_name(library, r), times, (100 * height[:, slot]).tolist())
        for slot, r in enumerate(rows)
    ]
    return line_chart(series, title="object height", x_label=TIME, y_label="cm")


def _object_name(library: MotionLibrary, row: int) -> str:
    return shorten(str(library.manifest["objects"][row]["name"]), OBJECT_NAME)


def _peaks(name: str, values: Floats, fps: float) -> Series:
    """Largest value of equal stretches: the mean would hide a short fault."""
    width = math.ceil(len(values) / MAX_POINTS)
    starts = range(0, len(values), width)
    highest = [float(values[i : i + width].max()) for i in starts]
    return Series(name, [i / fps for i in starts], highest)


def _words(facts: RecordingFacts) -> str:
    figures = facts.figures
    parts = [
        figures.get("hands", "").replace(" ", " and "),
        figures.get("objects", ""),
        f"{number(facts.value('seconds'), 2)} s",
        f"tips off {number(facts.value('tip_error_median_mm'))} mm (median), "
        f"{number(facts.value('tip_error_p95_mm'))} mm (p95)",
        f"hand in objects {number(facts.value('penetration_p95_mm'))} mm (p95), "
        f"{number(facts.value('penetration_max_mm'))} mm (max)",
        facts.source,
    ]
    return "; ".join(part for part in parts if part)


def _figure(library: MotionLibrary, row: int, stills: bytes) -> Html:
    data = base64.b64encode(stills).decode("ascii")
    image = f'<img src="data:image/jpeg;base64,{data}" alt="stills" loading="lazy">'
    words = [
        tag("span", f"{word} {frame / library.fps:.2f} s")
        for word, frame in still_frames(library, row).items()
    ]
    return tag("figure", Html(image), tag("figcaption", *words, class_="four"))
