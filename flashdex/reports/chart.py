"""Line charts as SVG: axes, curves and their places in the drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from flashdex.reports.page import render

WIDTH, HEIGHT = 400, 230
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 32, 40
COLOURS = ("#1f5fa8", "#c2410c", "#2f7d32", "#6b4fa0", "#555555")
DASHES = ("none", "6 3", "2 3", "8 3 2 3", "1 2")  # told apart without colour too
MAX_POINTS = 300
Points = list[tuple[float, float]]


@dataclass(frozen=True)
class Series:
    """One curve of n points; its name is shown when there are several curves."""

    name: str
    x: Sequence[float]
    y: Sequence[float]

    def points(self) -> Points:
        """Pairs in order; what is not finite is left out."""
        pairs = zip(self.x, self.y, strict=True)
        return [(x, y) for x, y in pairs if math.isfinite(x) and math.isfinite(y)]


@dataclass(frozen=True)
class Axis:
    """Map from values, ``low`` to ``high``, to the drawing, ``start`` to ``end``.

    Ticks are values with a label; start and end are pixels.
    """

    low: float
    high: float
    ticks: Sequence[float]
    start: float
    end: float

    @classmethod
    def horizontal(cls, low: float, high: float) -> Axis:
        """From ``low`` to ``high``, with the round values between them."""
        if high <= low:
            high = low + (abs(low) or 1.0)
        ticks = [t for t in nice_ticks(low, high) if low <= t <= high]
        return cls(low, high, ticks, LEFT, WIDTH - RIGHT)

    @classmethod
    def vertical(cls, values: Sequence[float]) -> Axis:
        """Between round values around all of ``values``."""
        ticks = nice_ticks(min(values), max(values))
        return cls(ticks[0], ticks[-1], ticks, HEIGHT - BOTTOM, TOP)

    def at(self, value: float) -> float:
        """Place of a value, pixels."""
        share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def labels(self) -> list[tuple[float, str]]:
        """Place and text of each tick."""
        return [(self.at(value), format_tick(value)) for value in self.ticks]


def line_chart(
    series: Sequence[Series],  # curves
    *,
    title: str,  # heading above the axes; the label of y stands beside it
    x_label: str,  # with its unit
    y_label: str = "",  # with its unit
    is_step: bool = False,  # hold each value until the next point, as counts want it
    y_range: tuple[float, float] | None = None,  # values that are in sight in any case
) -> Markup:
    """Draw curves over one pair of axes; one without points is left out.

    Returns:
        An ``<svg>`` element that scales with its container.

    Example:
        >>> "polyline" in line_chart(
        ...     [Series("a", [0, 1], [2, 3])], title="", x_label=""
        ... )
        True
    """
    title = f"{title}, {y_label}" if y_label else title
    drawn = [(s.name, points) for s in series if (points := s.points())]
    if not drawn:
        return draw_chart(title)
    xs, ys = zip(*(pair for _, points in drawn for pair in points), strict=True)
    x_axis = Axis.horizontal(min(xs), max(xs))
    y_axis = Axis.vertical([*ys, *(y_range or ())])
    curves = []
    for index, (_, points) in enumerate(drawn):
        shown = _steps(points) if is_step else _thin(points)
        places = [f"{x_axis.at(x):.1f},{y_axis.at(y):.1f}" for x, y in shown]
        curves.append((places, *_stroke(index)))
    return draw_chart(
        title,
        x_axis,
        x_label=x_label,
        y_ticks=y_axis.labels(),
        curves=curves,
        legend=_legend([name for name, _ in drawn]),
    )


def draw_chart(
    title: str, x_axis: Axis | None = None, *, x_label: str = "", **drawn: Any
) -> Markup:
    """Fill ``chart.svg`` with what is drawn; without an axis there is no data."""
    frame = {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT}
    frame["base"] = HEIGHT - BOTTOM
    return render(
        "chart.svg", title=title, x_axis=x_axis, x_label=x_label, **frame, **drawn
    )


def _stroke(index: int) -> tuple[str, str]:
    return COLOURS[index % len(COLOURS)], DASHES[index % len(DASHES)]


def _legend(names: list[str]) -> list[tuple[str, float, str, str]]:
    """Name, place, colour and dash of each of several curves, right to left."""
    entries, x = [], float(WIDTH - RIGHT)
    for index in reversed(range(len(names) if len(names) > 1 else 0)):
        x -= 7 * len(names[index])
        entries.append((names[index], x, *_stroke(index)))
        x -= 36
    return entries


def nice_ticks(low: float, high: float, *, count: int = 5) -> list[float]:
    """Round values that cover a range, about ``count`` intervals of them.

    Example:
        >>> nice_ticks(0, 97)
        [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]
    """
    # a narrower range than the labels have digits for is drawn as a level line
    if high - low <= 1e-3 * max(abs(low), abs(high)):
        pad = abs(low) * 0.1
        low, high = (low - pad, high + pad) if pad else (0.0, 1.0)
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def format_tick(value: float) -> str:
    """Short number: ``300M``, ``2.5k``, ``0.04``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:.4g}"


def stretches(num_points: int) -> list[slice]:
    """At most ``MAX_POINTS`` equal stretches: a long run must not make a heavy page."""
    width = max(1, math.ceil(num_points / MAX_POINTS))
    return [slice(i, i + width) for i in range(0, num_points, width)]


def _steps(points: Points) -> Points:
    out = points[:1]
    for x, y in points[1:]:
        out += [(x, out[-1][1]), (x, y)]
    return out


def _thin(points: Points) -> Points:
    """Means of equal stretches."""
    parts = [points[part] for part in stretches(len(points))]
    return [
        (sum(x for x, _ in part) / len(part), sum(y for _, y in part) / len(part))
        for part in parts
    ]
