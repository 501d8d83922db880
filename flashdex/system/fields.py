"""Dataclass fields that carry their allowed range."""

from __future__ import annotations

import dataclasses
from typing import Any

SEED_MAX = 2**31 - 1  # numpy's old generators, MuJoCo and JAX take no larger seed


def number(
    default: Any,
    *,
    high: float,
    low: float | None = None,
    above: float | None = None,
) -> Any:
    """A dataclass field that is at most ``high``, at least ``low`` or above ``above``.

    Both ends are given: what has none lets infinity, NaN and slips of the keyboard
    through. Building the dataclass checks nothing; recipes are checked as pydantic
    reads them.

    Raises:
        TypeError: there is no lower end.
    """
    return dataclasses.field(default=default, metadata=_range(low, above, high))


def _range(low: float | None, above: float | None, high: float) -> dict[str, float]:
    given = {"gt": above, "ge": low, "le": high}
    found = {key: value for key, value in given.items() if value is not None}
    if len(found) != 2:
        raise TypeError("a number has a lower end, low or above, and a high one")
    return found
