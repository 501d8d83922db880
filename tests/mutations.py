"""Seeded accidents and attacks on the files of a folder, for libraries and runs.

``plan`` draws cases over all files of a folder; each is applied to a copy of it::

    for case in plan(original, count=100, seed=0):
        shutil.copytree(original, folder, symlinks=True)
        case.apply(folder)
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
# what stands where another type or size of value belongs
VALUES = (
    *(None, True, -1, 0, 2**70, 1e308, float("nan"), float("inf"), "", "x" * 5000),
    *("../../evil", "/etc/passwd", "a\0b", "a\nb", [], {}, [[[[]]]], {"_type": "os"}),
)


@dataclass(frozen=True)
class Mutation:
    """One change of one file."""

    kind: str
    file: str  # below the folder
    seed: int

    def __str__(self) -> str:
        return f"{self.kind}-{self.file}-{self.seed}"

    def apply(self, folder: Path) -> None:
        """Change the file in a copy of the folder."""
        KINDS[self.kind](folder / self.file, np.random.default_rng(self.seed))


def plan(
    folder: Path, *, count: int, seed: int, kinds: tuple[str, ...] = ()
) -> list[Mutation]:
    """Cases over the files of a folder: every kind about equally often, seeded."""
    rng = np.random.default_rng(seed)
    files = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and not path.is_symlink() and path.stat().st_size
    )
    chosen = kinds or tuple(KINDS)
    cases = []
    for i in range(count):
        kind = chosen[i % len(chosen)]
        fitting = [f for f in files if not kind.startswith("json") or _is_json(f)]
        file = fitting[int(rng.integers(len(fitting)))] if fitting else files[0]
        if kind.startswith("json") and not fitting:
            kind = "flip"
        cases.append(Mutation(kind, file, int(rng.integers(2**31))))
    return cases


def _is_json(file: str) -> bool:
    return file.endswith((".json", ".jsonl"))


def snapshot(path: Path) -> dict[str, bytes | int]:
    """Content of every file, links and pipes by their kind only."""
    return {
        str(p.relative_to(path)): p.read_bytes()
        if p.is_file() and not p.is_symlink()
        else os.lstat(p).st_mode
        for p in sorted(path.rglob("*"))
    }


def flip(path: Path, rng: Rng) -> None:
    """One bit is another."""
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def truncate(path: Path, rng: Rng) -> None:
    """The end is missing."""
    data = path.read_bytes()
    path.write_bytes(data[: int(rng.integers(len(data)))])


def empty(path: Path, rng: Rng) -> None:
    """Nothing is left, as after a crash of some file systems."""
    path.write_bytes(b"")


def grow(path: Path, rng: Rng) -> None:
    """Zeros or noise follow the end."""
    tail = rng.bytes(1 + int(rng.integers(4096)))
    with path.open("ab") as file:
        file.write(tail if rng.integers(2) else b"\0" * len(tail))


def zeros(path: Path, rng: Rng) -> None:
    """A block was never written."""
    _overwrite(path, rng, lambda n: b"\0" * n)


def noise(path: Path, rng: Rng) -> None:
    """A block is of something else."""
    _overwrite(path, rng, rng.bytes)


def _overwrite(path: Path, rng: Rng, make: Callable[[int], bytes]) -> None:
    data = bytearray(path.read_bytes())
    start = int(rng.integers(len(data)))
    length = min(len(data) - start, 1 + int(rng.integers(512)))
    data[start : start + length] = make(length)
    path.write_bytes(data)


def swap(path: Path, rng: Rng) -> None:
    """The file and another of the same ending have changed places."""
    others = [p for p in path.parent.glob(f"*{path.suffix}") if p != path]
    if not others:
        flip(path, rng)
        return
    other = sorted(others)[int(rng.integers(len(others)))]
    mine, its = path.read_bytes(), other.read_bytes()
    path.write_bytes(its)
    other.write_bytes(mine)


def remove(path: Path, rng: Rng) -> None:
    """It is not there."""
    path.unlink()


def link(path: Path, rng: Rng) -> None:
    """A link to the same content in another folder; who writes to it writes there."""
    outside = Path(tempfile.mkdtemp(prefix="flashdex-outside-")) / path.name
    shutil.move(path, outside)
    path.symlink_to(outside)


def dangling(path: Path, rng: Rng) -> None:
    """A link to nothing."""
    path.unlink()
    path.symlink_to("/nonexistent/file")


def folder(path: Path, rng: Rng) -> None:
    """A folder in the place of the file."""
    path.unlink()
    path.mkdir()


def fifo(path: Path, rng: Rng) -> None:
    """A pipe, which whoever opens it waits for."""
    path.unlink()
    os.mkfifo(path)


def json_value(path: Path, rng: Rng) -> None:
    """One value of a JSON file, or of one of its lines, is something else."""

    def change(holder: Any, key: Any) -> None:
        holder[key] = VALUES[int(rng.integers(len(VALUES)))]

    _edit(path, rng, change)


def json_number(path: Path, rng: Rng) -> None:
    """One number is another; where there is none, one value."""

    def change(holder: Any, key: Any) -> None:
        value = holder[key]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        holder[key] = value * 1.5 + 1 if is_number else [value]

    _edit(path, rng, change)


def json_remove(path: Path, rng: Rng) -> None:
    """One entry is missing."""
    _edit(path, rng, lambda holder, key: holder.pop(key))


def json_double(path: Path, rng: Rng) -> None:
    """One entry of a list stands twice; of a mapping, under another name as well."""

    def change(holder: Any, key: Any) -> None:
        if isinstance(holder, list):
            holder.insert(key, holder[key])
        else:
            holder[f"{key}_"] = holder[key]

    _edit(path, rng, change)


def _edit(path: Path, rng: Rng, change: Callable[[Any, Any], Any]) -> None:
    """Change one place of a JSON file, or of one line of a JSONL file."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines() if path.suffix == ".jsonl" else [text]
    row = int(rng.integers(len(lines)))
    value = json.loads(lines[row])
    places = list(_places(value))
    if not places:
        flip(path, rng)
        return
    change(*places[int(rng.integers(len(places)))])
    lines[row] = json.dumps(value)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    keys = list(value) if isinstance(value, dict) else range(len(value))
    for key in keys:
        yield value, key
        if isinstance(value[key], dict | list):
            yield from _places(value[key])


KINDS: dict[str, Callable[[Path, Rng], None]] = {
    one.__name__: one
    for one in (
        *(flip, truncate, empty, grow, zeros, noise, swap, remove),
        *(link, dangling, folder, fifo),
        *(json_value, json_number, json_remove, json_double),
    )
}
