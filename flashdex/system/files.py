"""Files that are there complete, or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO, cast

from filelock import FileLock, Timeout

from flashdex.errors import RunError

# of an open file: a link in its place is an error, a pipe is not waited for
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def own_file(root: Path, *parts: str) -> Path:
    """Path of a file that a run or a library may read, write and delete as its own.

    ``root`` may be a link, as its user chose it; below it there is none: a link would
    lead what is written, deleted or shown out of the folder. A pipe or a device in its
    place would be waited for.

    Args:
        root: folder of the run or library.
        parts: of the path below it; a part may hold slashes, as manifests do.

    Raises:
        RunError: the path leaves the folder, or something else stands there.
    """
    path = root.joinpath(*parts)
    names = Path(*parts).parts
    if not names or ".." in names or Path(*parts).is_absolute():
        raise RunError(f"{root}: '{Path(*parts)}' is not a file below it.")
    for depth in range(1, len(names) + 1):
        below = root.joinpath(*names[:depth])
        try:
            mode = below.lstat().st_mode
        except FileNotFoundError:
            return path
        except (OSError, ValueError) as error:  # NUL, over-long, not a folder
            raise RunError(f"{str(below)!a}: cannot be read ({error}).") from error
        is_right = stat.S_ISREG(mode) if depth == len(names) else stat.S_ISDIR(mode)
        if not is_right:
            kind = "a file" if depth == len(names) else "a folder"
            raise RunError(
                f"{below}: is {_kind(mode)}, not {kind} of its own. Only files and "
                f"folders that lie in {root} are used; put {kind} there, or remove it."
            )
    return path


def own_files(root: Path, folder: str, pattern: str) -> list[Path]:
    """Files of a folder of a run or library, sorted; as ``own_file`` each."""
    found = sorted((root / folder).glob(pattern))
    return [own_file(root, folder, path.name) for path in found]


def own_folder(root: Path, name: str) -> Path:
    """A folder directly below a run or library, made where it is missing.

    Raises:
        RunError: a link or a file stands there.
    """
    path = root / name
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise RunError(
            f"{path}: is {_kind(path.lstat().st_mode)}, not a folder of its own. Only "
            f"what lies in {root} is used; remove it."
        )
    path.mkdir(parents=True, exist_ok=True)
    return path


def _kind(mode: int) -> str:
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFREG: "a file"}
    return kinds.get(stat.S_IFMT(mode), "a pipe or a device")


def open_plain(path: Path, mode: str = "rb") -> BinaryIO:
    """Open a file itself: not what a link names, no pipe, no device.

    Args:
        path: of the file.
        mode: ``rb``, ``ab`` or ``r+b``.

    Raises:
        OSError: it is something else, or cannot be opened.
    """
    flags = {"rb": os.O_RDONLY, "ab": os.O_WRONLY | os.O_APPEND | os.O_CREAT}
    handle = os.open(path, flags.get(mode, os.O_RDWR) | _PLAIN, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return cast(BinaryIO, os.fdopen(handle, mode))


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing; it takes its name only when the block succeeds.

    A reader, or a run that continues after a crash, finds the old file or the whole new
    one. What was written is on the disk when the block ends.

    Example:
        >>> with open_atomic(Path("notes.bin")) as file:  # doctest: +SKIP
        ...     file.write(b"all of it")
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # beside the target, as a rename is atomic within one file system only
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        # a link that waits under this name is not followed
        temporary.unlink(missing_ok=True)
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomic(path: Path, text: str) -> None:
    """Write a text file, UTF-8, as ``open_atomic`` does."""
    with open_atomic(path) as file:
        file.write(text.encode("utf-8"))


@contextmanager
def waiting_lock(path: Path) -> Iterator[None]:
    """Hold ``<path>.lock`` while the block runs; other processes wait for it.

    It goes with the process, however that ends. Without file locks, or where the file
    cannot be made, the block runs without one.

    Args:
        path: what is being made; its directory is made.
    """
    with ExitStack() as held:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = path.with_name(f".{path.name}.lock")
            held.enter_context(FileLock(lock, fallback_to_soft=False))
        yield


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content; read once while size and time stay the same."""
    found = path.stat()
    return _hash_file(path, found.st_size, found.st_mtime_ns)


@cache
def _hash_file(path: Path, size: int, changed: int) -> str:
    del size, changed  # they are part of the cache's key only
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


LOCK = ".lock"


@contextmanager
def run_lock(run_dir: Path) -> Iterator[None]:
    """Hold a run directory; a second training process there is refused.

    File systems without locks are used without one.

    Raises:
        RunError: another process trains in it.
    """
    (run_dir / LOCK).touch()  # a folder that cannot be written is an error
    with ExitStack() as held:
        lock = FileLock(run_dir / LOCK, blocking=False, fallback_to_soft=False)
        try:
            held.enter_context(lock)
        except Timeout as error:
            raise RunError(
                f"{run_dir}: another process is training in this folder. Wait for it, "
                "stop it, or choose another folder with run_dir=..."
            ) from error
        except OSError:
            pass
        yield
