"""Pieces of a self-contained page: escaped text, tables, inline files, the style."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

NOTHING = "\u2013"  # a dash
MEDIA = {".png": "image/png", ".mp4": "video/mp4"}

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif;
  color: #1a1a1a; background: #fff; margin: 0 auto; max-width: 1240px; padding: 24px; }
h1 { font-size: 1.6rem; margin: 0 0 2px; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 36px 0 10px; border-bottom: 1px solid #ccc;
  padding-bottom: 4px; }
h3 { font-size: 1rem; margin: 18px 0 6px; overflow-wrap: anywhere; }
p { margin: 6px 0; } .soft { color: #555; } .bad { color: #a01515; }
.good { color: #1c6b2a; } .small { font-size: .85rem; }
.numbers { display: flex; flex-wrap: wrap; gap: 12px; margin: 18px 0; }
.numbers div { border: 1px solid #ccc; border-radius: 6px; padding: 8px 16px;
  min-width: 118px; }
.numbers b { display: block; font-size: 1.6rem; font-variant-numeric: tabular-nums; }
.charts { display: grid; gap: 14px;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 320px), 1fr)); }
.charts.large { grid-template-columns: repeat(auto-fit,
  minmax(min(100%, 420px), 1fr)); }
svg { width: 100%; height: auto; display: block; break-inside: avoid;
  font: 12px system-ui, sans-serif; fill: #333; }
svg .t { font-weight: 600; fill: #1a1a1a; font-size: 13px; }
svg .g { stroke: #e4e4e4; } svg .a { stroke: #444; }
svg .c { fill: none; stroke-width: 1.8; stroke-linejoin: round; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .82rem;
  font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 5px 6px; border-bottom: 1px solid #ddd;
  vertical-align: top; }
th { font-weight: 600; vertical-align: bottom; border-bottom: 2px solid #888; }
th:first-child, td:first-child, .left { text-align: left; }
td:first-child { min-width: 8em; } td:last-child { min-width: 9em; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 16px;
  margin: 8px 0;
  font-size: .9rem; }
dt { color: #555; } dd { margin: 0; overflow-wrap: anywhere; }
.tag { border: 1px solid #999; border-radius: 3px; padding: 0 4px; font-size: .75rem;
  color: #555; white-space: nowrap; }
.films { display: grid; gap: 18px;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
figure { margin: 0; break-inside: avoid; }
video, img { width: 100%; height: auto; display: block; border: 1px solid #ccc; }
figcaption { font-size: .85rem; margin-top: 4px; overflow-wrap: anywhere; }
@media screen and (max-width: 760px) {
  body { padding: 14px; }
  thead { position: absolute; left: -9999px; }
  tr { display: block; border: 1px solid #ccc; border-radius: 6px; margin: 0 0 12px;
    padding: 6px 10px; }
  td { display: flex; justify-content: space-between; gap: 14px; border: 0;
    padding: 2px 0; text-align: right; }
  td:first-child { font-weight: 600; font-size: 1rem; overflow-wrap: anywhere; }
  td:not(:first-child)::before { content: attr(data-label); color: #555;
    text-align: left; flex: none; max-width: 55%; }
  td.left { text-align: right; }
}
@media print {
  body { max-width: none; padding: 0; font-size: 11px; }
  table { font-size: 8.5px; } tr { break-inside: avoid; }
  .charts, .charts.large { grid-template-columns: 1fr 1fr 1fr; }
  .charts.large { grid-template-columns: 1fr 1fr; }
  .films { grid-template-columns: 1fr 1fr; } video { display: none; }
}
"""


@dataclass(frozen=True)
class Html:
    """Text that is markup already; everything else is escaped on its way in.

    Args:
        text: safe markup.
    """

    text: str


def safe(value: Any) -> str:
    """Markup as it is, anything else escaped.

    Args:
        value: ``Html`` or a value with a text form.

    Example:
        >>> safe("<b>"), safe(Html("<b>"))
        ('&lt;b&gt;', '<b>')
    """
    return value.text if isinstance(value, Html) else escape(str(value), quote=True)


def tag(name: str, *children: Any, **attributes: Any) -> Html:
    """One element; ``class_`` stands for the attribute ``class``.

    Args:
        name: element.
        *children: content, escaped unless it is ``Html``.
        **attributes: values, escaped; ``_`` becomes ``-``.
    """
    words = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value), quote=True)}"'
        for key, value in attributes.items()
        if value != ""
    )
    return Html(f"<{name}{words}>{''.join(map(safe, children))}</{name}>")


def joined(parts: Iterable[Html], separator: str = "\n") -> Html:
    """Markup after markup.

    Args:
        parts: pieces.
        separator: text between them.
    """
    return Html(separator.join(part.text for part in parts))


def table(headings: Sequence[Any], rows: Sequence[Sequence[Any]]) -> Html:
    """A table whose cells carry their heading, for narrow screens.

    Args:
        headings: one a column.
        rows: cells, escaped unless they are ``Html``.
    """
    head = tag("thead", tag("tr", *(tag("th", h) for h in headings)))
    body = [
        tag(
            "tr",
            *(
                tag("td", c, data_label=str(h))
                for h, c in zip(headings, row, strict=True)
            ),
        )
        for row in rows
    ]
    return tag("table", head, tag("tbody", joined(body)))


def facts(pairs: Iterable[tuple[str, Any]]) -> Html:
    """A list of names and values.

    Args:
        pairs: name and value; pairs without a value are left out.
    """
    shown = [(name, value) for name, value in pairs if value not in ("", None)]
    return tag(
        "dl",
        *(tag(t, v) for pair in shown for t, v in zip(("dt", "dd"), pair, strict=True)),
    )


def inline(path: Path) -> str:
    """A file as a ``data:`` address.

    Args:
        path: png or mp4.
    """
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"data:{MEDIA[path.suffix]};base64,{data}"


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits, or a dash for what was not measured.

    Args:
        value: number or None.
        digits: behind the point.
    """
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:,.{digits}f}"


def duration(seconds: float) -> str:
    """Time in words, e.g. ``2 h 05 min``.

    Args:
        seconds: s.

    Example:
        >>> duration(7500), duration(95)
        ('2 h 05 min', '1 min 35 s')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def page(title: str, body: Iterable[Html]) -> str:
    """The document, without any address outside itself.

    Args:
        title: of the window.
        body: sections.
    """
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body>\n{joined(body).text}\n</body></html>\n"
    )


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
