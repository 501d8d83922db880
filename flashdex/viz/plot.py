"""Small line charts as SVG text, written by hand: no plotting package, no script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 400, 230
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 32, 40
COLOURS = ("#1f5fa8", "#c2410c", "#2f7d32", "#6b4fa0", "#555555")
DASHES = ("", "6 3", "2 3", "8 3 2 3", "1 2")  # told apart without colour too
MAX_POINTS = 300


@dataclass(frozen=True)
class Series:
    """One curve.

    Args:
        name: shown in the legend when there are several curves.
        x: positions, (n,).
        y: values, (n,); pairs that are not finite are left out.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]

    def points(self) -> list[tuple[float, float]]:
        """Finite pairs in order."""
        pairs = zip(self.x, self.y, strict=True)
        return [(x, y) for x, y in pairs if math.isfinite(x) and math.isfinite(y)]


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str = "",
    is_step: bool = False,
    y_range: tuple[float, float] | None = None,
) -> str:
    """Draw curves over one pair of axes.

    Args:
        series: curves; one without points is left out.
        title: heading above the axes.
        x_label: under the axis, with its unit.
        y_label: beside the heading, with its unit.
        is_step: hold each value until the next point, as counts want it.
        y_range: values that are in sight in any case.

    Returns:
        An ``<svg>`` element that scales with its container.

    Example:
        >>> "polyline" in line_chart(
        ...     [Series("a", [0, 1], [2, 3])], title="", x_label=""
        ... )
        True
    """
    curves = [(s.name, s.points()) for s in series]
    curves = [(name, points) for name, points in curves if points]
    head = _head(f"{title}, {y_label}" if y_label else title)
    if not curves:
        middle = f'x="{WIDTH // 2}" y="{HEIGHT // 2}" text-anchor="middle"'
        return f"{head}<text {middle}>no data yet</text></svg>"
    scale = _Scale.around([p for _, points in curves for p in points], y_range)
    body = scale.axes(x_label)
    for index, (_, points) in enumerate(curves):
        shown = _steps(points) if is_step else _thin(points)
        body += scale.polyline(shown, index)
    return head + body + _legend([name for name, _ in curves]) + "</svg>"


def _head(title: str) -> str:
    name = escape(title)
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{name}">'
        f'<text x="{LEFT}" y="16" class="t">{name}</text>'
    )


@dataclass(frozen=True)
class _Scale:
    """Axes: values at the ticks, and the map from values to the drawing."""

    x_ticks: list[float]
    y_ticks: list[float]
    x_range: tuple[float, float]

    @classmethod
    def around(
        cls, points: list[tuple[float, float]], y_range: tuple[float, float] | None
    ) -> _Scale:
        xs, ys = [p[0] for p in points], [p[1] for p in points]
        if y_range is not None:
            ys += y_range
        low, high = min(xs), max(xs)
        if high <= low:
            high = low + (abs(low) or 1.0)
        x_ticks = [t for t in nice_ticks(low, high) if low <= t <= high]
        return cls(x_ticks, nice_ticks(min(ys), max(ys)), (low, high))

    def x(self, value: float) -> float:
        low, high = self.x_range
        return LEFT + (value - low) / (high - low) * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        low, high = self.y_ticks[0], self.y_ticks[-1]
        return HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)

    def axes(self, x_label: str) -> str:
        out = []
        for value in self.y_ticks:
            y = self.y(value)
            out.append(
                f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" '
                f'class="g"/><text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">'
                f"{format_tick(value)}</text>"
            )
        base = HEIGHT - BOTTOM
        for value in self.x_ticks:
            x = self.x(value)
            out.append(
                f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{base}" y2="{base + 4}" '
                f'class="a"/><text x="{x:.1f}" y="{base + 17}" text-anchor="middle">'
                f"{format_tick(value)}</text>"
            )
        middle = (LEFT + WIDTH - RIGHT) / 2
        out.append(
            f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{base}" y2="{base}" '
            f'class="a"/>'
            f'<text x="{middle:.0f}" y="{HEIGHT - 7}" text-anchor="middle">'
            f"{escape(x_label)}</text>"
        )
        return "".join(out)

    def polyline(self, points: list[tuple[float, float]], index: int) -> str:
        colour = COLOURS[index % len(COLOURS)]
        dash = DASHES[index % len(DASHES)]
        if len(points) == 1:
            (x, y) = points[0]
            spot = f'cx="{self.x(x):.1f}" cy="{self.y(y):.1f}" r="3"'
            return f'<circle {spot} fill="{colour}"/>'
        drawn = " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in points)
        stroke = f'stroke="{colour}" stroke-dasharray="{dash or "none"}"'
        return f'<polyline points="{drawn}" class="c" {stroke}/>'


def _legend(names: list[str]) -> str:
    if len(names) < 2:
        return ""
    out, x = [], WIDTH - RIGHT
    for index in reversed(range(len(names))):
        x -= 7 * len(names[index])
        out.append(f'<text x="{x}" y="16">{escape(names[index])}</text>')
        stroke = f'stroke="{COLOURS[index % len(COLOURS)]}"'
        dash = f'stroke-dasharray="{DASHES[index % len(DASHES)] or "none"}"'
        line = f'x1="{x - 24}" x2="{x - 5}" y1="12" y2="12"'
        out.append(f'<line {line} class="c" {stroke} {dash}/>')
        x -= 36
    return "".join(out)


def nice_ticks(low: float, high: float, *, count: int = 5) -> list[float]:
    """Round values that cover a range, about ``count`` of them.

    Args:
        low: smallest value.
        high: largest value; a range without width is widened.
        count: wanted number of intervals.

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
    """Short number: ``300M``, ``2.5k``, ``0.04``.

    Args:
        value: at the tick.
    """
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:.4g}"


def _steps(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    out = points[:1]
    for x, y in points[1:]:
        out += [(x, out[-1][1]), (x, y)]
    return out


def _thin(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Means of equal stretches: a long run must not make a heavy page."""
    width = math.ceil(len(points) / MAX_POINTS)
    parts = [points[i : i + width] for i in range(0, len(points), width)]
    return [
        (sum(x for x, _ in part) / len(part), sum(y for _, y in part) / len(part))
        for part in parts
    ]
