"""Arrays of ``.npy`` and ``.npz`` files: plain numbers and texts of bounded size.

Nothing in such a file can be executed: object arrays, which are pickles, are refused
unless the caller has a reader for them. What a file announces is compared with what it
holds before anything of that size is allocated.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

MAX_BYTES = 2 << 30  # of a file, and of what it becomes; more is a mistake or an attack
MAX_ENTRIES = 10_000
# above this size an archive that unpacks to more than so many times its own is a bomb
USUAL_BYTES, MAX_RATIO = 64 << 20, 100


def load_arrays(
    path: Path, *, only: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """The arrays of a ``.npz`` file, or those of them that are named.

    Raises:
        OSError: it is missing, cannot be read, or is no regular file.
        ValueError: it is damaged, too large, holds objects, or is another kind of file.
    """
    if not path.is_file():  # a pipe would be waited for, a device has no end
        raise FileNotFoundError(f"{path}: no such file")
    with path.open("rb") as file:
        return read_npz(file, only=only)


def read_npz(
    file: IO[bytes],
    *,
    only: Collection[str] | None = None,
    objects: Callable[[IO[bytes]], Any] | None = None,
) -> dict[str, Any]:
    """Entries of an open ``.npz`` file; see ``load_arrays`` and ``read_array``."""
    with ExitStack() as held:
        with _told():
            archive = held.enter_context(zipfile.ZipFile(file))
        names = [name for name in archive.namelist() if name.endswith(".npy")]
        if not names:
            raise ValueError("it holds no .npy entries")
        keys = {name.removesuffix(".npy"): name for name in names}
        wanted = {k: v for k, v in keys.items() if only is None or k in only}
        check_archive(archive, wanted.values())
        found = {}
        for key, name in wanted.items():
            with _told():
                data = archive.read(name)
            found[key] = read_array(data, objects=objects)
        return found


@contextmanager
def _told() -> Iterator[None]:
    """A ``ValueError`` of whatever zipfile, zlib and lzma raise of unsound bytes."""
    try:
        yield
    except (MemoryError, OSError, ValueError):
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}"
        raise ValueError(f"not a sound archive: {told}") from error


def check_archive(archive: zipfile.ZipFile, wanted: Collection[str]) -> None:
    """Refuse an archive whose wanted entries unpack to too much, before any is read.

    Raises:
        ValueError: says how much.
    """
    members = archive.infolist()
    if len(members) > MAX_ENTRIES:
        raise ValueError(f"{len(members)} entries; at most {MAX_ENTRIES}")
    chosen = [archive.getinfo(name) for name in wanted]
    size = sum(member.file_size for member in chosen)
    # entries that lie on one another count with what they claim, hence the file's size
    packed = min(sum(m.compress_size for m in chosen), _size_of(archive))
    if size > MAX_BYTES or (size > USUAL_BYTES and size > MAX_RATIO * packed):
        raise ValueError(
            f"{packed / 2**20:.1f} MiB that unpack to {size / 2**20:.0f} MiB; at most "
            f"{MAX_BYTES >> 30} GiB and {MAX_RATIO} times the size are allowed"
        )


def _size_of(archive: zipfile.ZipFile) -> int:
    assert archive.fp is not None
    place = archive.fp.tell()
    size = archive.fp.seek(0, io.SEEK_END)
    archive.fp.seek(place)
    return size


def read_array(
    data: bytes, *, objects: Callable[[IO[bytes]], Any] | None = None
) -> Any:
    """The array of a ``.npy`` file's content.

    Args:
        data: the whole file.
        objects: reads the pickle of an object array, which becomes that array, or its
            only element where it has no dimensions; None refuses those.

    Raises:
        ValueError: it is damaged, holds objects, or announces another size.
    """
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    name = "read_array_header_{}_{}".format(*version)
    shape, by_columns, dtype = getattr(np.lib.format, name)(file)
    if dtype.kind == "O" and objects is not None:
        array = objects(file)
        if not isinstance(array, np.ndarray) or array.dtype.kind != "O":
            raise ValueError("an object array that holds something else")
        return array.item() if array.ndim == 0 else array
    if dtype.hasobject:
        raise ValueError("an array of objects; plain numbers and texts are allowed")
    count = math.prod(check_sizes(shape))
    if count * dtype.itemsize > len(data):
        raise ValueError(f"shape {shape} of {dtype} does not fit to {len(data)} bytes")
    raw = bytearray(file.read(count * dtype.itemsize))
    order = "F" if by_columns else "C"
    return np.frombuffer(raw, dtype, count).reshape(shape, order=order)


def check_sizes(given: Any) -> tuple[int, ...]:
    """Whole numbers from 0 up, as sizes of an array."""
    sizes = (given,) if isinstance(given, int) else given
    known = isinstance(sizes, (tuple, list)) and len(sizes) <= 32
    if not known or not all(
        isinstance(n, (int, np.integer)) and 0 <= n <= MAX_BYTES for n in sizes
    ):
        raise ValueError(f"{given!r} are not sizes")
    return tuple(int(n) for n in sizes)
