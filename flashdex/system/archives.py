"""Zip archives of arrays, opened as foreign ones: bounded, checked, never unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from flashdex.errors import is_of_machine

MAX_BYTES = 4 << 30  # of what a file becomes; more is a mistake or an attack
MAX_MEMBERS = 100_000
# plain arrays hardly shrink further; small ones may, as masks of zeros do
MAX_RATIO, RATIO_FROM = 200, 64 << 20
MAX_HEADER = 10_000  # bytes of a .npy header; numpy writes 118


def check_sizes(archive: zipfile.ZipFile, *, limit: int = MAX_BYTES) -> None:
    """Refuse an archive that unpacks to more than ``limit`` bytes, before it does.

    Raises:
        ValueError: it does, or it grows as no archive of data does.
    """
    members = archive.infolist()
    size = sum(member.file_size for member in members)
    stored = sum(member.compress_size for member in members)
    if len(members) > MAX_MEMBERS:
        raise ValueError(f"it holds {len(members)} files, {MAX_MEMBERS} are allowed")
    if size > limit:
        raise ValueError(
            f"it unpacks to {size / 2**20:.0f} MiB, {limit / 2**20:.0f} are allowed"
        )
    if size > RATIO_FROM and size > MAX_RATIO * stored:
        raise ValueError(
            f"it unpacks to {size / 2**20:.0f} MiB, {size / max(stored, 1):.0f} times "
            f"what is stored; {MAX_RATIO} are allowed"
        )


def check_archive(file: Path | IO[bytes], *, limit: int = MAX_BYTES) -> None:
    """Read a whole archive once: its sizes, and the checksum of every member.

    Raises:
        ValueError: it is no archive, too large, or damaged.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            check_sizes(archive, limit=limit)
            damaged = archive.testzip()
    # damaged bytes make zipfile and zlib raise nearly any exception
    except Exception as error:
        if isinstance(error, OSError | ValueError) or is_of_machine(error):
            raise
        raise ValueError(f"not a whole archive ({error})") from error
    if damaged is not None:
        raise ValueError(f"its part {damaged!r} is damaged: the checksum differs")


def read_npz(path: Path, *, limit: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """All arrays of a ``.npz``; every checksum is checked, nothing is unpickled.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is something else, too large, damaged, or holds objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            check_sizes(archive, limit=limit)
            names = archive.namelist()
            odd = [name for name in names if not name.endswith(".npy")]
            if odd or len(set(names)) != len(names) or not names:
                raise ValueError(f"not an archive of arrays: {odd[:1] or names[:1]}")
            # reading to the end compares the checksum
            content = {n.removesuffix(".npy"): archive.read(n) for n in names}
    except Exception as error:
        if isinstance(error, OSError | ValueError) or is_of_machine(error):
            raise
        raise ValueError(f"not a whole archive ({error})") from error
    arrays = {}
    for name, data in content.items():
        try:
            arrays[name] = read_array(data)
        except ValueError as error:
            raise ValueError(f"'{name}': {error}") from error
    return arrays


def read_array(
    data: bytes, *, unpickle: Callable[[IO[bytes]], Any] | None = None
) -> Any:
    """The array of the bytes of a ``.npy``; its own memory, nothing beyond the data.

    Args:
        data: of the file.
        unpickle: reads an array of objects; the only one of it, where it has no axes.

    Raises:
        ValueError: damaged, of objects without ``unpickle``, or its shape does not fit
            to the bytes.
    """
    file = io.BytesIO(data)
    shape, by_columns, dtype = read_header(file, objects=unpickle is not None)
    if unpickle is not None and dtype.kind == "O":
        array = unpickle(file)
        if not isinstance(array, np.ndarray) or array.dtype.kind != "O":
            raise ValueError("an object array that holds something else")
        return array.item() if array.ndim == 0 else array
    count, start = math.prod(shape), file.tell()
    if count * dtype.itemsize != len(data) - start:
        raise ValueError(f"{shape} of {dtype} does not fit to {len(data)} bytes")
    flat = np.frombuffer(bytearray(memoryview(data)[start:]), dtype, count)
    return flat.reshape(shape, order="F" if by_columns else "C")


def read_header(
    file: IO[bytes], *, objects: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether by columns, and type of a ``.npy``; the file stands at its data.

    Raises:
        ValueError: damaged, of nothing, with impossible sizes, or of objects where
            these are not wanted.
    """
    try:
        version = np.lib.format.read_magic(file)
        read = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")
        shape, by_columns, dtype = read(file, max_header_size=MAX_HEADER)
    except ValueError:
        raise
    except MemoryError:  # Python's parser says so of text that is too deep for it
        raise ValueError("its header is nested too deep") from None
    except Exception as error:
        raise ValueError(f"not the header of an array ({error})") from error
    is_plain = not dtype.hasobject and not dtype.names
    is_empty = dtype.itemsize == 0 and dtype.kind not in "US"
    if is_empty or not (is_plain or (objects and dtype.kind == "O")):
        raise ValueError(f"it holds {dtype}, not plain numbers or text")
    if any(not 0 <= n <= MAX_BYTES for n in shape) or len(shape) > 32:
        raise ValueError(f"{shape} are not sizes")
    return shape, by_columns, dtype
