"""Opens the files of datasets; whatever is wrong with one becomes one clear message."""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from flashdex.datasets.pickles import MAX_BYTES, RefusedError, unpickle
from flashdex.errors import DemoError, is_of_machine
from flashdex.system.archives import open_archive, read_array
from flashdex.system.jsonl import parse_json
from flashdex.system.pickled import check_tensors

POINTER_START = b"version https://git-lfs"
MAX_TEXT = 64 << 20  # bytes of a text file; lines and cells take fifty times as much
POINTER_SIZE = 200  # bytes; a pointer holds three short lines
# what is raised by content of another layout, or nested too deep
BROKEN = (
    *(ValueError, TypeError, LookupError, AttributeError),
    *(OverflowError, RecursionError),
)


def refuse_pointer(file: Path) -> None:
    """Refuse a Git-LFS pointer that stands where the file should be, or no file.

    ``FileNotFoundError`` where there is nothing at all.
    """
    if not file.is_file() and (file.exists() or file.is_symlink()):
        raise DemoError(
            f"{file}: cannot be read: not a file but a folder, a pipe, a device or a "
            f"broken link. Put the file itself there.",
            code="E_FILE",
        )
    if file.stat().st_size >= POINTER_SIZE:
        return
    with file.open("rb") as stream:
        start = stream.read(len(POINTER_START))
    if start == POINTER_START:
        raise DemoError(
            f"{file}: a Git-LFS pointer, not the file itself. Download the content: "
            f"git lfs pull, or the dataset's own tool.",
            code="E_ROOT",
        )


def refuse_large(file: Path, most: int) -> None:
    """Refuse a file of more bytes than any recording has; a sparse one costs nothing.

    What is read whole, and parsed, must fit in memory several times.
    """
    size = file.stat().st_size
    if size > most:
        raise DemoError(
            f"{file}: {size / 2**20:.0f} MiB; at most {most >> 20} MiB are read. Cut "
            f"the recording, or get the file anew.",
            code="E_FILE",
        )


def refuse_clone(files: Iterable[Path]) -> None:
    """Refuse a clone whose content was not fetched: its first files are pointers.

    Whatever else is wrong with a file costs its own recording only, when it is read.
    """
    for file in files:
        if file.is_file():
            refuse_pointer(file)


@contextmanager
def told(where: Path | str, fault: str, *, code: str | None = None) -> Iterator[None]:
    """Turns what content of another layout raises into one message.

    Errors of the machine pass as they are, see ``is_of_machine``.
    ``fault`` says what it is not, and what to do.
    """
    try:
        yield
    except (OSError, *BROKEN) as error:
        if is_of_machine(error):
            raise
        if isinstance(error, OSError):
            text = f"{where}: cannot be read: {error.strerror or error}."
            raise DemoError(text, code="E_FILE") from error
        shown = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise DemoError(f"{where}: {fault}: {shown}.", code=code) from error


def read_json(file: Path, fault: str, *, code: str | None = None) -> Any:
    """The content of a JSON file; ``fault`` says of another file what it is not."""
    with told(file, fault, code=code):
        return parse_json(read_bytes(file, most=MAX_TEXT))


def read_text(file: Path) -> str:
    """A text file of bounded size, UTF-8; an ``OSError`` or ``UnicodeDecodeError``."""
    return read_bytes(file, most=MAX_TEXT).decode("utf-8")


def read_bytes(file: Path, *, most: int = MAX_BYTES) -> bytes:
    """A regular file of at most so many bytes, whole; an ``OSError`` is not told."""
    refuse_pointer(file)
    refuse_large(file, most)
    with file.open("rb") as stream:
        return stream.read()


def load_pickle(path: Path) -> Any:
    """The content of a pickle, see ``unpickle``; a ``DemoError`` if it is not data."""
    return _open(path, "pickle", lambda file: unpickle(io.BytesIO(file.read())))


def load_npy(path: Path) -> Any:
    """The array of a ``.npy`` file, or the only element of one without dimensions."""
    size = path.stat().st_size if path.is_file() else 0
    return _open(path, ".npy array", partial(read_array, size=size, unpickle=unpickle))


def load_npz(
    path: Path, *, only: Collection[str] | None = None, plain: bool = False
) -> dict[str, Any]:
    """Entries of a ``.npz`` file, each as ``load_npy`` gives it.

    ``only`` names those that are wanted, as far as they are there; ``plain`` refuses
    entries that hold objects.
    """
    kind = ".npz without pickles" if plain else ".npz archive"
    entries = _open(path, kind, partial(_read_npz, only=only))
    for name, array in entries.items():
        if plain and (not isinstance(array, np.ndarray) or array.dtype.kind == "O"):
            raise DemoError(
                f"{path}: not a readable {kind}: '{name}' holds objects. Store plain "
                f"arrays; text as np.array([...], dtype=str)."
            )
    return entries


def load_torch(path: Path) -> Any:
    """The content of a file of ``torch.save``: tensors on the CPU, plain containers."""
    return _open(path, "torch file", _read_torch)


def _open(path: Path, kind: str, read: Callable[[IO[bytes]], Any]) -> Any:
    try:
        refuse_pointer(path)
        with path.open("rb") as file:
            refuse_large(path, MAX_BYTES)
            return read(file)
    except DemoError:
        raise
    except RefusedError as error:
        raise DemoError(
            f"{path}: it tried to load {error}, which is not data, so it was not read. "
            f"Don't open it with anything else; get the file anew from where the "
            f"dataset is published.",
            code="E_PICKLE",
        ) from error
    # Damaged bytes make pickle, zipfile, numpy and torch raise nearly any exception.
    except Exception as error:
        if is_of_machine(error):
            raise
        if isinstance(error, OSError):
            text = f"{path}: cannot be read: {error.strerror or error}"
            raise DemoError(text) from error
        told = " ".join(str(error).split())[:200] or type(error).__name__
        raise DemoError(
            f"{path}: not a readable {kind}: {told}. It is damaged or incomplete, or "
            f"of another kind; unpack or download it anew."
        ) from error


def _read_npz(file: IO[bytes], only: Collection[str] | None) -> dict[str, Any]:
    with open_archive(file, limit=MAX_BYTES) as archive:
        files = [name for name in archive.namelist() if name.endswith(".npy")]
        if not files:
            raise ValueError("it holds no .npy entries")
        names = {name.removesuffix(".npy"): name for name in files}
        wanted = {k: v for k, v in names.items() if only is None or k in only}
        return {k: _read_member(archive, name) for k, name in wanted.items()}


def _read_member(archive: zipfile.ZipFile, name: str) -> Any:
    with archive.open(name) as file:
        size = archive.getinfo(name).file_size
        return read_array(file, size, unpickle=unpickle)


def _read_torch(file: IO[bytes]) -> Any:
    import torch  # slow to import, and few readers need it

    check_tensors(file, limit=MAX_BYTES)
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        if found is None:
            # torch's own text advises to read such a file without care
            text = "it is torn, or holds more than tensors in plain containers"
            raise ValueError(text) from error
        raise RefusedError(found.group(1)) from error
