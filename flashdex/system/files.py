"""Files that are there complete, or not at all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout

from flashdex.errors import RunError


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
        with temporary.open("wb") as file:
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
