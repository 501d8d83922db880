"""Entries of a file as what they should be: numbers, one number, one text."""

from __future__ import annotations

from typing import Any

import numpy as np

from flashdex.errors import DemoError


def numbers(value: Any, *, what: str) -> np.ndarray:
    """Real numbers of any shape, float64.

    Args:
        value: an array, a tensor, a list, or anything else.
        what: file and key, for the message.

    Raises:
        DemoError: it holds something else, or rows of different lengths.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"it holds {array.dtype}")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        told = " ".join(str(error).split())[:120]
        raise DemoError(f"{what}: E_KEYS: not numbers: {told}.") from error
    return array.astype(np.float64)


def number(value: Any, *, what: str) -> float:
    """One real number, in an array of any rank or alone.

    Raises:
        DemoError: it is something else.
    """
    array = numbers(value, what=what)
    if array.size != 1:
        raise DemoError(f"{what}: E_KEYS: shape {array.shape}; expected one number.")
    return float(array.reshape(()))


def words(value: Any) -> list[str]:
    """All texts of an array of any rank, or of one that stands alone."""
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    return [str(v) for v in value] if isinstance(value, (list, tuple)) else [str(value)]


def word(value: Any, *, what: str) -> str:
    """One text, in an array of any rank or alone.

    Raises:
        DemoError: there are none or several.
    """
    found = words(value)
    if len(found) != 1:
        raise DemoError(f"{what}: E_KEYS: {len(found)} entries; expected one text.")
    return found[0]
