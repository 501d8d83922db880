"""Dataclass fields that carry their allowed range, and the reader of that range."""

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
    """Return a dataclass field with a default and an allowed range.

    Args:
        default: the value used when the recipe says nothing.
        low: smallest allowed value, itself allowed.
        high: largest allowed value, itself allowed.
        above: bound that the value must exceed, itself refused.
    """
    return dataclasses.field(
        default=default, metadata={"low": low, "high": high, "above": above}
    )


def range_problem(field: dataclasses.Field[Any], value: float) -> str | None:
    """Say in words how a value breaks the range of its field, or return None.

    Args:
        field: the dataclass field, made by `number` or plain (no range).
        value: the number the recipe gives.
    """
    low, high = field.metadata.get("low"), field.metadata.get("high")
    above = field.metadata.get("above")
    if above is not None and not value > above:
        return f"{value} must be greater than {above}"
    if low is not None and not value >= low:
        return f"{value} must be at least {low}"
    if high is not None and not value <= high:
        return f"{value} must be at most {high}"
    return None
