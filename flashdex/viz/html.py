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
