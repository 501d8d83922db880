"""Tracks that are stored as axis-angle vectors and translations, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flashdex.errors import DemoError


def track(data: Any, key: str, width: int, *, where: str) -> np.ndarray:
    """One track of a table, (T, width) float64.

    Args:
        data: the table: a mapping of names to arrays.
        key: of the track.
        width: numbers a frame.
        where: file and part of it, for messages.

    Raises:
        DemoError: the key is missing or its shape is another one.
    """
    stored = part(data, key, where=where)
    try:
        values = np.asarray(stored, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DemoError(f"{where}: {key} holds no numbers (E_KEYS).") from error
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise DemoError(
            f"{where}: {key} has shape {values.shape}; expected (T, {width}) (E_KEYS)."
        )
    return values


def part(data: Any, key: str, *, where: str) -> Any:
    """One entry of a table, whatever it is.

    Raises:
        DemoError: the key is missing.
    """
    if not isinstance(data, Mapping) or key not in data:
        kind = type(data).__name__
        found = ", ".join(map(str, data)) if isinstance(data, Mapping) else f"a {kind}"
        raise DemoError(f"{where}: lacks {key} (E_KEYS). Found: {found}.")
    return data[key]


def same_length(lengths: Mapping[str, int], *, where: str) -> int:
    """The number of frames that all tracks have.

    Raises:
        DemoError: they differ.
    """
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise DemoError(f"{where}: frames differ: {told} (E_LEN). Get the file anew.")
    return next(iter(lengths.values()))
