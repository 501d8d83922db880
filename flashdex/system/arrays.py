"""Arrays in files of their own, memory-mapped, described by a manifest beside them."""

from __future__ import annotations

import hashlib
import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import RunError
from flashdex.system.archives import MAX_BYTES, read_header
from flashdex.system.files import open_plain, own_file

MAX_HOLES = 1 << 30  # bytes of an array that take no place on the disk
KINDS = ("bool", "int32", "int64", "float32", "float64", "uint8")


@dataclass(frozen=True)
class ArrayEntry:
    """What a manifest says of one array: its type, its shape, its content's hash."""

    dtype: str
    shape: tuple[int, ...]
    sha256: str  # of the whole file

    @property
    def num_bytes(self) -> int:
        """Bytes of the data."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    def to_dict(self) -> dict[str, Any]:
        """The entry as JSON writes it."""
        return {"dtype": self.dtype, "shape": list(self.shape), "sha256": self.sha256}

    @classmethod
    def parse(cls, entry: Any) -> ArrayEntry:
        """Read an entry of a manifest.

        Raises:
            ValueError: it is none, or of a type or size that no array here has.
        """
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "sha256"}:
            raise ValueError(f"{entry!r:.80} is no entry of an array")
        dtype, shape, sha256 = entry["dtype"], entry["shape"], entry["sha256"]
        if dtype not in KINDS or not isinstance(sha256, str):
            raise ValueError(f"type {dtype!r:.40}; allowed are {', '.join(KINDS)}")
        sizes = shape if isinstance(shape, list) else [shape]
        if len(sizes) > 8 or not all(type(n) is int and n >= 0 for n in sizes):
            raise ValueError(f"{shape!r:.60} are not sizes")
        if math.prod(sizes) > 256 * MAX_BYTES:
            raise ValueError(f"{shape!r:.60} is larger than any library")
        return cls(dtype, tuple(sizes), sha256)


def write_array(path: Path, array: np.ndarray) -> ArrayEntry:
    """Write a ``.npy`` file, complete on the disk when this returns."""
    array = np.ascontiguousarray(array)
    if str(array.dtype) not in KINDS:
        raise TypeError(f"{path.name}: {array.dtype} is not one of {', '.join(KINDS)}")
    head = io.BytesIO()
    described = np.lib.format.header_data_from_array_1_0(array)
    np.lib.format.write_array_header_1_0(head, described)
    # of what is meant, not of what a disk made of it; numpy's own way of writing does
    # not see every error of a full one
    digest = hashlib.sha256(head.getvalue())
    data = array.reshape(-1).view(np.uint8).data
    digest.update(data)
    with path.open("xb") as file:
        file.write(head.getvalue())
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return ArrayEntry(str(array.dtype), array.shape, digest.hexdigest())


def map_array(root: Path, name: str, entry: ArrayEntry) -> np.ndarray:
    """Map a ``.npy`` file below ``root`` that holds just what its entry says.

    The map is private: what is written to it never reaches the file, and a file that is
    too short is refused, not filled up. The content is not read, see ``hash_content``.

    Raises:
        RunError: it is missing, a link, or of another type, shape or size.
    """
    path = own_file(root, name)
    try:
        with open_plain(path) as file:
            shape, by_columns, dtype = read_header(file)
            start, size = file.tell(), os.fstat(file.fileno()).st_size
            fault = _differs(entry, shape, by_columns, dtype, size - start)
            if not fault and _holes(file.fileno(), size) > MAX_HOLES:
                fault = f"has holes of more than {MAX_HOLES >> 20} MiB on the disk"
            if not fault and entry.num_bytes == 0:
                return np.empty(shape, dtype)
            if not fault:
                return np.memmap(file, dtype, "c", start, shape)
    except FileNotFoundError:
        fault = "is missing"
    except (OSError, ValueError) as error:
        fault = f"cannot be read ({error})"
    raise RunError(f"{path}: {fault}. It was damaged or changed.")


def _holes(descriptor: int, size: int) -> int:
    """Bytes of holes; a terabyte of them would be read for hours."""
    total, at = 0, 0
    while hasattr(os, "SEEK_HOLE") and at < size and total <= MAX_HOLES:
        start = os.lseek(descriptor, at, os.SEEK_HOLE)
        try:
            at = os.lseek(descriptor, start, os.SEEK_DATA)
        except OSError:  # to the end
            at = size
        total += at - start
    return total


def _differs(
    entry: ArrayEntry, shape: tuple[int, ...], by_columns: bool, dtype: Any, size: int
) -> str:
    if (shape, str(dtype), by_columns and len(shape) > 1) != (
        entry.shape,
        entry.dtype,
        False,
    ):
        return f"holds {dtype} {shape}, announced are {entry.dtype} {entry.shape}"
    if size != entry.num_bytes:
        return f"has {size} bytes of data, {entry.num_bytes} are announced"
    return ""


def hash_content(path: Path, *, most: int | None = None) -> str:
    """SHA-256 of a file, read now; empty for one of more than ``most`` bytes."""
    digest = hashlib.sha256()
    with open_plain(path) as file:
        if most is not None and os.fstat(file.fileno()).st_size > most:
            return ""
        try:
            while block := file.read(1 << 20):
                digest.update(block)
        except OSError as error:
            error.filename = str(path)  # reading alone does not say of what
            raise
    return digest.hexdigest()
