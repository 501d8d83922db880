"""JSON-lines files that survive a crash in the middle of a line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flashdex.system.files import write_atomic


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read a JSONL file; a last line cut off by a crash is left out."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    out = []
    for number, line in enumerate(lines):
        try:
            out.append(json.loads(line))
        except ValueError:
            if number < len(lines) - 1:
                raise
    return out


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Append one line; it is on the disk when this returns."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
        file.flush()
        os.fsync(file.fileno())


def drop_cut_line(path: Path) -> None:
    """Remove a last line that a crash cut off, or the next one would join it."""
    if not path.is_file():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("r+b") as file:
            file.truncate(whole)


def keep_lines(path: Path, wanted: Callable[[dict[str, Any]], bool]) -> None:
    """Keep the lines that are wanted, in their order; the file changes in one piece."""
    if not path.is_file():
        return
    drop_cut_line(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if wanted(json.loads(line))]
    if len(kept) < len(lines):
        write_atomic(path, "".join(line + "\n" for line in kept))
