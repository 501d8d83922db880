"""Files that keep computed objects, so that a mesh is decomposed once."""

from __future__ import annotations

import logging
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.system.files import open_atomic

logger = logging.getLogger(__name__)

Values = dict[str, Any]  # field of ObjectAsset to its value

SCALARS = ("radius", "sdf_spacing", "mass", "watertight")
DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


def write_cache(file: Path, values: Values) -> None:
    """Store the fields of an object as npz; a failure is logged and not fatal.

    Args:
        file: where; its directory is made.
        values: arrays, numbers, and ``parts``, a list of (V, 3) arrays.
    """
    arrays: Values = {k: np.asarray(v) for k, v in values.items() if k != "parts"}
    arrays["part_vertices"] = np.concatenate(values["parts"])
    arrays["part_sizes"] = np.array([len(p) for p in values["parts"]])
    try:
        with open_atomic(file) as stream:
            np.savez_compressed(stream, **arrays)
    except OSError as error:
        logger.warning("%s: object not cached (%s)", file, error)


def read_cache(file: Path, *, required: set[str]) -> Values | None:
    """Read what :func:`write_cache` stored.

    Args:
        file: the npz file.
        required: fields that must be there.

    Returns:
        The fields, or None when the file is absent, damaged or of another layout.
    """
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as stored:
            values: Values = {k: stored[k] for k in stored.files}
        cuts = np.cumsum(values.pop("part_sizes"))[:-1]
        values["parts"] = np.split(values.pop("part_vertices"), cuts)
        for scalar in SCALARS:
            values[scalar] = values[scalar].item()
        if set(values) != required:
            raise KeyError(*sorted(required ^ set(values)))
    except DAMAGED as error:
        logger.warning("%s: unreadable (%s); computing the object again", file, error)
        return None
    return values
