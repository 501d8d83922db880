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
    """A dataclass field that is at least ``low``, at most ``high``, above ``above``."""
    return dataclasses.field(
        default=default, metadata={"low": low, "high": high, "above": above}
    )


def range_problem(field: dataclasses.Field[Any], value: float) -> str | None:
    """How a value breaks the range of its field, in words; None where it does not."""
    low, high, above = (field.metadata.get(k) for k in ("low", "high", "above"))
    if above is not None and not value > above:
        return f"{value} must be greater than {above}"
    if low is not None and not value >= low:
        return f"{value} must be at least {low}"
    if high is not None and not value <= high:
        return f"{value} must be at most {high}"
    return None
