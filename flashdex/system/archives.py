"""Zip archives of arrays, opened as foreign ones: bounded, checked, never unpickled."""

from __future__ import annotations

import io
import math
import os
import re
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
MAX_DIRECTORY = 32 << 20  # bytes of the list of members
MAX_FILE = MAX_BYTES + (64 << 20)  # bytes of an archive, packed as badly as may be
BLOCK = 1 << 20  # bytes that are unpacked at a time
# the records at the end of an archive that say how long its list is, overlapping ones
# too: zipfile believes the last one; an old one of all ones leaves it to the newer
END_BYTES = (1 << 16) + 22 + 20 + 56
END = re.compile(rb"(?=PK\x05\x06.{8}(.{4})|PK\x06\x06.{36}(.{8}))", re.DOTALL)
FULL = 0xFFFFFFFF


def open_archive(file: Path | IO[bytes], *, limit: int = MAX_BYTES) -> zipfile.ZipFile:
    """Open an archive that unpacks to no more than ``limit`` bytes.

    Raises:
        ValueError: it does, or it grows as no archive of data does.
        Exception: zipfile and zlib raise nearly any on damaged bytes.
    """
    if isinstance(file, Path):
        with file.open("rb") as stream:
            _check_directory(stream)
    else:
        _check_directory(file)
    archive = zipfile.ZipFile(file)
    try:
        _check_sizes(archive, limit)
    except ValueError:
        archive.close()
        raise
    return archive


def _check_directory(file: IO[bytes]) -> None:
    """Refuse a list of members that fills the memory while it is read: ten times it.

    ``zipfile`` believes its length, wherever it stands, and not its count.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - END_BYTES))
    tail = file.read(END_BYTES)
    file.seek(0)
    lengths = [int.from_bytes(a or b, "little") for a, b in END.findall(tail)]
    if any(n > MAX_DIRECTORY for n in lengths if n != FULL) or size > MAX_FILE:
        raise ValueError(f"its list of files is larger than {MAX_DIRECTORY >> 20} MiB")


def _check_sizes(archive: zipfile.ZipFile, limit: int) -> None:
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
        with open_archive(file, limit=limit) as archive:
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
        with open_archive(path, limit=limit) as archive:
            names = archive.namelist()
            odd = [name for name in names if not name.endswith(".npy")]
            if odd or len(set(names)) != len(names) or not names:
                raise ValueError(f"not an archive of arrays: {odd[:1] or names[:1]}")
            return {n.removesuffix(".npy"): _read_member(archive, n) for n in names}
    except Exception as error:
        if isinstance(error, OSError | ValueError) or is_of_machine(error):
            raise
        raise ValueError(f"not a whole archive ({error})") from error


def _read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as file:
        try:
            return read_array(file, archive.getinfo(name).file_size)
        except ValueError as error:
            key = name.removesuffix(".npy")
            raise ValueError(f"'{key}': {error}") from error


def read_array(
    file: IO[bytes], size: int, *, unpickle: Callable[[IO[bytes]], Any] | None = None
) -> Any:
    """The array of a ``.npy`` of ``size`` bytes, in memory of its own, but once.

    Args:
        file: at its beginning.
        size: of the file.
        unpickle: reads an array of objects; the only one of it, where it has no axes.

    Raises:
        ValueError: damaged, of objects without ``unpickle``, or its shape does not fit
            to the bytes.
    """
    shape, by_columns, dtype = read_header(file, objects=unpickle is not None)
    if unpickle is not None and dtype.kind == "O":
        array = unpickle(io.BytesIO(file.read()))
        if not isinstance(array, np.ndarray) or array.dtype.kind != "O":
            raise ValueError("an object array that holds something else")
        return array.item() if array.ndim == 0 else array
    count, rest = math.prod(shape), size - file.tell()
    if count * dtype.itemsize != rest:
        raise ValueError(f"{shape} of {dtype} does not fit to {size} bytes")
    data, at = bytearray(rest), 0
    # reading to the end compares the checksum of an archive
    while part := file.read(BLOCK):
        if at + len(part) > rest:
            raise ValueError(f"more than {size} bytes")
        data[at : at + len(part)] = part
        at += len(part)
    if at < rest:
        raise ValueError(f"cut off after {at} of {rest} bytes")
    flat = np.frombuffer(data, dtype, count)
    return flat.reshape(shape, order="F" if by_columns else "C")


def _read_head(file: IO[bytes]) -> bytes:
    """Magic, version, length and text of a header, as far as they are there."""
    head = file.read(10)
    if head[6:7] > b"\1":  # whose length has four bytes
        head += file.read(2)
    size = int.from_bytes(head[8:], "little")
    return head + file.read(min(size, MAX_HEADER + 1))


def read_header(
    file: IO[bytes], *, objects: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether by columns, and type of a ``.npy``; the file stands at its data.

    ``objects`` lets arrays of them pass, whose data are a pickle.

    Raises:
        ValueError: damaged, of nothing, with impossible sizes, or of objects where
            these are not wanted.
    """
    head = io.BytesIO(_read_head(file))  # what the file itself fails at is no damage
    try:
        version = np.lib.format.read_magic(head)
        read = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")
        shape, by_columns, dtype = read(head, max_header_size=MAX_HEADER)
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
