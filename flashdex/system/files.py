"""Files that are there complete, or not at all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from flashdex.errors import RunError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing; it takes its name only when the block succeeds.

    A reader, or a run that continues after a crash, finds the old file or the whole new
    one. What was written is on the disk when the block ends.

    Args:
        path: the file; its directory is made, an older file is replaced.

    Example:
        >>> with open_atomic(Path("notes.bin")) as file:  # doctest: +SKIP
        ...     file.write(b"all of it")
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # beside the target, as a rename is atomic within one file system only
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomic(path: Path, text: str) -> None:
    """Write a text file, UTF-8, as ``open_atomic`` does.

    Args:
        path: the file.
        text: its content.
    """
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
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.with_name(f".{path.name}.lock").open("w")
    except OSError:
        yield
        return
    with file:
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content; read once while size and time stay the same."""
    stat = path.stat()
    return _hash_file(path, stat.st_size, stat.st_mtime_ns)


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

    Args:
        run_dir: existing run directory.

    Raises:
        RunError: another process trains in it.
    """
    if fcntl is None:
        yield
        return
    with (run_dir / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"{run_dir}: another process is training in this folder. Wait for it, "
                "stop it, or choose another folder with run_dir=..."
            ) from error
        except OSError:
            pass
        yield
