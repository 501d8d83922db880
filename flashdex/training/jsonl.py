"""JSON-lines files that survive a crash in the middle of a line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


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


def drop_cut_line(path: Path) -> None:
    """Remove a last line that a crash cut off, or the next one would join it.

    Args:
        path: JSONL file; need not exist.
    """
    if not path.is_file():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("r+b") as file:
            file.truncate(whole)
