"""Files that are there complete, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


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
