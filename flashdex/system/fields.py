"""Dataclass fields that carry their allowed range."""

from __future__ import annotations

import dataclasses
from typing import Any


def number(
    default: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
) -> Any:
    """A dataclass field that is at least ``low``, at most ``high``, above ``above``.

    Building the dataclass checks nothing; recipes are checked as pydantic reads them.
    """
    ranges = {"gt": above, "ge": low, "le": high}
    return dataclasses.field(default=default, metadata=ranges)
