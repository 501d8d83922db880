"""The annotation of an OakInk2 sequence, ``anno_preview/<token>.pkl``, as tracks."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import QUAT_TOLERANCE
from flashdex.datasets.fields import poses_from_matrices, require, row, to_array
from flashdex.datasets.files import load_pickle, read_json
from flashdex.datasets.roots import find_mesh
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

ANNOTATIONS, PROGRAMS = "anno_preview", "program/program_info"
FIELDS = ("mocap_frame_id_list", "obj_list", "obj_transf", "raw_mano")
HAND_FIELDS = {"pose_coeffs": 64, "tsl": 3, "betas": 10}
NUM_JOINTS = 16
OBJECT_ID = re.compile(r"\w[\w@.+-]*")  # such as O02@0206@00001
# Keys are short pairs of pairs. What is longer is not parsed: a literal can be made
# deep enough to exhaust the parser.
MAX_KEY = 200
# Primitives that only bridge others; the dataset's own tools leave them out as well.
TRANSIENT = ("hold", "rearrange", "swap", "?(unk)")
PREFIX: dict[Side, str] = {"left": "lh", "right": "rh"}

Interval = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """One item of a program."""

    # mocap ids (begin, end excluded) in which each hand does its part; a hand
    # with nothing to do is missing
    intervals: dict[Side, Interval]
    name: str  # of the primitive; empty if it has none
    mode: str  # ``lh_main``, ``rh_main`` or ``bh_main``; empty if unknown
    hand_objects: dict[Side, list[str]]  # object ids of each hand
    objects: list[str]  # object ids of both hands, without repeats; empty if unknown

    @property
    def begin(self) -> int:
        """First mocap id of either hand."""
        return min(begin for begin, _ in self.intervals.values())

    @property
    def end(self) -> int:
        """One past the last mocap id of either hand."""
        return max(end for _, end in self.intervals.values())


def read_program(file: Path) -> list[Primitive]:
    """All primitives that are not transient, in time order."""
    items = read_json(file, "not a readable program", code="E_KEYS")
    if not isinstance(items, dict):
        raise DemoError(
            f"{file}: holds a {type(items).__name__}; expected a dict of "
            f"primitives by their intervals, like '((0, 120), (60, 240))'.",
            code="E_KEYS",
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
            f"{file}: {key!r} holds a {type(item).__name__}; expected a dict.",
            code="E_KEYS",
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
    """Intervals of both hands from a key like ``(None, (0, 240))``, never evaluated."""
    try:
        value = ast.literal_eval(key.strip()) if len(key) <= MAX_KEY else None
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        value = None
    pair = value if isinstance(value, tuple) and len(value) == 2 else (None, None)
    if not any(pair) or not all(p is None or _is_interval(p) for p in pair):
        shown = key if len(key) < 60 else f"{key[:60]}..."
        raise DemoError(
            f"{where}: key {shown!r} is not a pair of intervals. Expected the "
            f"left and the right hand's (begin, end) in mocap ids, or None, like "
            f"'(None, (0, 240))'.",
            code="E_KEYS",
        )
    return {s: p for s, p in zip(SIDES, pair, strict=True) if p is not None}


def _is_interval(value: Any) -> bool:
    whole = isinstance(value, tuple | list) and len(value) == 2
    return whole and all(type(v) is int for v in value) and 0 <= value[0] < value[1]


def _ids(file: Path, item: dict[str, Any], key: str) -> list[str]:
    value = item.get(key) or []
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise DemoError(
            f"{file}: {key} is {value!r}; expected a list of ids.", code="E_KEYS"
        )
    return value


@dataclass
class HandTrack:
    """MANO parameters of one hand; NaN where it was not tracked."""

    quats: np.ndarray  # local joint rotations wxyz, about unit, (T, 16, 4)
    wrist: np.ndarray  # m, (T, 3)
    betas: np.ndarray  # (T, 10); constant in time as a rule


@dataclass
class Annotation:
    """Tracks of one sequence: frame i has the mocap id ``first + i``, 120 a second."""

    first: int  # mocap id of the first frame
    num_frames: int  # up to the last id; an id that is missing in between is NaN
    hands: dict[Side, HandTrack]  # both
    poses: dict[str, np.ndarray]  # of each object, m and wxyz, (T, 7)
    notes: list[str] = field(default_factory=list)  # what was repaired


def read_annotation(file: Path) -> Annotation:
    """Read one annotation."""
    data = load_pickle(file)
    require(data, *FIELDS, where=str(file))
    mocap_ids, names, transforms, hands = (data[key] for key in FIELDS)
    ids = _frame_ids(file, mocap_ids)
    first, num_frames = int(ids[0]), int(ids[-1] - ids[0] + 1)
    out = Annotation(first, num_frames, hands={}, poses={})
    for side in SIDES:
        out.hands[side] = _read_hand(file, hands, side, ids, out.notes)
    for name in _object_ids(file, names):
        what = f"{file}: obj_transf[{name!r}]"
        by_frame = transforms.get(name) if isinstance(transforms, dict) else None
        rows = _rows(by_frame, ids, lambda m, w=what: to_array(m, 16, what=w), 16, what)
        pose, notes = poses_from_matrices(rows.reshape(-1, 4, 4), what=what)
        out.poses[name] = pose
        out.notes += notes
    return out


def _frame_ids(file: Path, value: Any) -> np.ndarray:
    """Mocap ids, ascending; they advance by one at 120 Hz."""
    try:
        ids = np.unique(np.array([int(v) for v in value], dtype=np.int64))
    except (TypeError, ValueError, OverflowError) as error:
        raise DemoError(
            f"{file}: mocap_frame_id_list is not a list of integers.", code="E_KEYS"
        ) from error
    whole = len(ids) >= 2 and ids[0] >= 0
    if not whole or np.median(np.diff(ids)) != 1 or np.ptp(ids) >= 2 * len(ids):
        raise DemoError(
            f"{file}: {len(ids)} mocap ids do not advance by one; expected "
            f"every frame at 120 Hz. Are these the ids of the images, at 30 Hz?",
            code="W_FPS",
        )
    return ids


def _object_ids(file: Path, value: Any) -> list[str]:
    good = isinstance(value, list | tuple) and len(value) > 0
    if not good or not all(isinstance(name, str) for name in value):
        raise DemoError(f"{file}: obj_list is not a list of object ids.", code="E_KEYS")
    return list(dict.fromkeys(value))


def _rows(
    by_frame: Any,
    ids: np.ndarray,
    read: Callable[[Any], np.ndarray],
    width: int,
    what: str,
) -> np.ndarray:
    """A row a frame, (T, width); NaN where the frame has no entry."""
    if not isinstance(by_frame, dict) or not by_frame:
        raise DemoError(f"{what} is not a dict by frame.", code="E_KEYS")
    rows = np.full((ids[-1] - ids[0] + 1, width), np.nan)
    for frame in ids.tolist():
        if frame in by_frame:
            rows[frame - ids[0]] = read(by_frame[frame])
    return rows


def _read_hand(
    file: Path, by_frame: Any, side: Side, ids: np.ndarray, notes: list[str]
) -> HandTrack:
    where = f"{file}: raw_mano"
    sizes = {f"{PREFIX[side]}__{name}": size for name, size in HAND_FIELDS.items()}

    read = partial(row, sizes=sizes, where=where, file=str(file))
    rows = _rows(by_frame, ids, read, sum(sizes.values()), where)
    if np.isnan(rows).all():
        raise DemoError(f"{file}: raw_mano has none of the mocap ids.", code="E_KEYS")
    quats = rows[:, :64].reshape(-1, NUM_JOINTS, 4)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    off = np.abs(norms - 1) > QUAT_TOLERANCE
    if off.any():
        notes.append(f"E_ROT: {side} hand: {off.sum()} quaternions made unit")
    return HandTrack(quats, rows[:, 64:67], rows[:, 67:])


@dataclass(frozen=True, kw_only=True)
class OakInk2Sequence:
    """Where one sequence lies."""

    root: Path  # of the dataset
    token: str  # ``scene_..++...``, the name of its files
    mesh_folders: tuple[Path, ...]  # that hold a folder for each object, best first
    mano: Path  # folder of the hand model

    @property
    def annotation(self) -> Path:
        """Hands and objects."""
        return self.root / ANNOTATIONS / f"{self.token}.pkl"

    @property
    def program(self) -> Path:
        """Primitives; it may be missing."""
        return self.root / PROGRAMS / f"{self.token}.json"

    def mesh_file(self, name: str) -> Path:
        """The one mesh of an object."""
        if not OBJECT_ID.fullmatch(name):
            raise DemoError(
                f"{self.token}: object id {name!r} is not a plain name.", code="E_KEYS"
            )
        return find_mesh(name, self.mesh_folders, where=self.token)
