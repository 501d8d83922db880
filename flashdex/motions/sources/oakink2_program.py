"""The primitives of an OakInk2 sequence, from ``program/program_info/<token>.json``."""

from __future__ import annotations

import ast
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

# Keys are short pairs of pairs. What is longer is not parsed: a literal can be made
# deep enough to exhaust the parser.
MAX_KEY = 200
# Primitives that only bridge others; the dataset's own tools leave them out as well.
TRANSIENT = ("hold", "rearrange", "swap", "?(unk)")
PREFIX: dict[Side, str] = {"left": "lh", "right": "rh"}

Interval = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """One item of a program.

    Args:
        intervals: mocap ids (begin, end excluded) in which each hand does its part; a
            hand with nothing to do is missing.
        name: of the primitive; empty if it has none.
        mode: ``lh_main``, ``rh_main`` or ``bh_main``; empty if unknown.
        hand_objects: object ids of each hand.
        objects: object ids of both hands, without repeats; empty if unknown.
    """

    intervals: dict[Side, Interval]
    name: str
    mode: str
    hand_objects: dict[Side, list[str]]
    objects: list[str]

    @property
    def begin(self) -> int:
        """First mocap id of either hand."""
        return min(begin for begin, _ in self.intervals.values())

    @property
    def end(self) -> int:
        """One past the last mocap id of either hand."""
        return max(end for _, end in self.intervals.values())


def read_program(file: Path) -> list[Primitive]:
    """All primitives that are not transient, in time order.

    Raises:
        DemoError: the file is not a program, or nothing but transient primitives.
    """
    try:
        items = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DemoError(
            f"{file}: E_KEYS: not a readable program (.json): {error}"
        ) from error
    if not isinstance(items, dict):
        raise DemoError(
            f"{file}: E_KEYS: holds a {type(items).__name__}; expected a dict of "
            f"primitives by their intervals, like '((0, 120), (60, 240))'."
        )
    found = [_primitive(file, key, item) for key, item in items.items()]
    kept = [primitive for primitive in found if primitive.name not in TRANSIENT]
    if not kept:
        raise DemoError(
            f"{file}: no primitive to use: {len(found)} in all, those called "
            f"{', '.join(TRANSIENT)} are left out."
        )
    return sorted(kept, key=lambda p: (p.begin, p.end))


def _primitive(file: Path, key: str, item: Any) -> Primitive:
    if not isinstance(item, dict):
        raise DemoError(
            f"{file}: E_KEYS: {key!r} holds a {type(item).__name__}; expected a dict."
        )
    hands: dict[Side, list[str]] = {
        side: _ids(file, item, f"obj_list_{PREFIX[side]}") for side in SIDES
    }
    touched = [name for side in SIDES for name in hands[side]]
    return Primitive(
        intervals=parse_intervals(key, where=file),
        name=str(item.get("primitive") or "").strip(),
        mode=str(item.get("interaction_mode") or ""),
        hand_objects=hands,
        objects=list(dict.fromkeys(touched or _ids(file, item, "obj_list"))),
    )


def parse_intervals(key: str, *, where: Path | str) -> dict[Side, Interval]:
    """Intervals of the left and the right hand from a key like ``(None, (0, 240))``.

    Args:
        key: text of a Python tuple; never evaluated.
        where: file, for the message.

    Raises:
        DemoError: it is not a pair of intervals, or none of them is given.
    """
    try:
        value = ast.literal_eval(key.strip()) if len(key) <= MAX_KEY else None
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        value = None
    pair = value if isinstance(value, tuple) and len(value) == 2 else (None, None)
    if not any(pair) or not all(p is None or _is_interval(p) for p in pair):
        shown = key if len(key) < 60 else f"{key[:60]}..."
        raise DemoError(
            f"{where}: E_KEYS: key {shown!r} is not a pair of intervals. Expected the "
            f"left and the right hand's (begin, end) in mocap ids, or None, like "
            f"'(None, (0, 240))'."
        )
    return {s: p for s, p in zip(SIDES, pair, strict=True) if p is not None}


def _is_interval(value: Any) -> bool:
    whole = isinstance(value, tuple | list) and len(value) == 2
    return whole and all(type(v) is int for v in value) and 0 <= value[0] < value[1]


def _ids(file: Path, item: dict[str, Any], key: str) -> list[str]:
    value = item.get(key) or []
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise DemoError(f"{file}: E_KEYS: {key} is {value!r}; expected a list of ids.")
    return value
