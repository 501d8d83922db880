"""Numbers, times and tables as text, for the terminal and for pages."""

from __future__ import annotations

import math
from collections.abc import Sequence

NOTHING = "\u2013"  # a dash
MAX_WIDTH = 100  # columns of a terminal


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits behind the point, or a dash for what was not measured."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:,.{digits}f}"


def plain(value: float | None, digits: int = 1) -> str:
    """A number without separators, or ``-``."""
    missing = value is None or not math.isfinite(value)
    return "-" if missing else f"{value:.{digits}f}"


def short(value: float) -> str:
    """Three digits and a letter of a count: ``12.3M``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.0f}"


def duration(seconds: float) -> str:
    """Time in words, e.g. ``2 h 05 min``.

    Example:
        >>> duration(7500), duration(95)
        ('2 h 05 min', '1 min 35 s')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def shorten(text: str, width: int) -> str:
    """Cut a text of more than ``width`` characters, marked by dots."""
    return text if len(text) <= width else f"{text[: width - 2]}.."


def align(cells: Sequence[Sequence[str]], *, left: Sequence[int] = (0,)) -> list[str]:
    """Lay rows of equal length out in columns: numbers, but those aligned ``left``."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        " ".join(
            f"{cell:<{width}}" if index in left else f"{cell:>{width}}"
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
