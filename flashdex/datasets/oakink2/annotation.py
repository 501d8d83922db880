"""The annotation of an OakInk2 sequence, ``anno_preview/<token>.pkl``, as tracks."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import QUAT_TOLERANCE
from flashdex.datasets.fields import poses_from_matrices, to_array
from flashdex.datasets.pickles import load_pickle
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


FIELDS = ("mocap_frame_id_list", "obj_list", "obj_transf", "raw_mano")
HAND_FIELDS = {"pose_coeffs": 64, "tsl": 3, "betas": 10}
NUM_JOINTS = 16


@dataclass
class HandTrack:
    """MANO parameters of one hand; NaN where it was not tracked.

    Args:
        quats: local joint rotations wxyz, about unit, (T, 16, 4).
        wrist: m, (T, 3).
        betas: (T, 10); constant in time as a rule.
    """

    quats: np.ndarray
    wrist: np.ndarray
    betas: np.ndarray


@dataclass
class Annotation:
    """Tracks of one sequence: frame i has the mocap id ``first + i``, 120 a second.

    Args:
        first: mocap id of the first frame.
        num_frames: up to the last id; an id that is missing in between is NaN.
        hands: both.
        poses: of each object, m and wxyz, (T, 7).
        notes: what was repaired.
    """

    first: int
    num_frames: int
    hands: dict[Side, HandTrack]
    poses: dict[str, np.ndarray]
    notes: list[str] = field(default_factory=list)


def read_annotation(file: Path) -> Annotation:
    """Read one annotation.

    Raises:
        DemoError: the pickle is refused, or a field is missing or wrong.
    """
    data = load_pickle(file)
    lacks = [k for k in FIELDS if not isinstance(data, dict) or k not in data]
    if lacks:
        raise DemoError(f"{file}: E_KEYS: lacks {', '.join(lacks)}.")
    ids = _frame_ids(file, data["mocap_frame_id_list"])
    first, num_frames = int(ids[0]), int(ids[-1] - ids[0] + 1)
    out = Annotation(first, num_frames, hands={}, poses={})
    for side in SIDES:
        out.hands[side] = _read_hand(file, data["raw_mano"], side, ids, out.notes)
    transforms = _require_dict(file, "obj_transf", data["obj_transf"])
    for name in _object_ids(file, data["obj_list"]):
        what = f"{file}: obj_transf[{name!r}]"
        by_frame = _require_dict(file, f"obj_transf[{name!r}]", transforms.get(name))
        rows = _rows(by_frame, ids, lambda m, w=what: to_array(m, 16, what=w), 16)
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
            f"{file}: E_KEYS: mocap_frame_id_list is not a list of integers."
        ) from error
    whole = len(ids) >= 2 and ids[0] >= 0
    if not whole or np.median(np.diff(ids)) != 1 or np.ptp(ids) >= 2 * len(ids):
        raise DemoError(
            f"{file}: W_FPS: {len(ids)} mocap ids do not advance by one; expected "
            f"every frame at 120 Hz. Are these the ids of the images, at 30 Hz?"
        )
    return ids


def _object_ids(file: Path, value: Any) -> list[str]:
    good = isinstance(value, list | tuple) and len(value) > 0
    if not good or not all(isinstance(name, str) for name in value):
        raise DemoError(f"{file}: E_KEYS: obj_list is not a list of object ids.")
    return list(dict.fromkeys(value))


def _require_dict(file: Path, key: str, value: Any) -> dict:
    if not isinstance(value, dict) or not value:
        raise DemoError(f"{file}: E_KEYS: {key} is not a dict by frame or object.")
    return value


def _rows(
    by_frame: dict, ids: np.ndarray, read: Callable[[Any], np.ndarray], width: int
) -> np.ndarray:
    """A row a frame, (T, width); NaN where the frame has no entry."""
    rows = np.full((ids[-1] - ids[0] + 1, width), np.nan)
    for frame in ids.tolist():
        if frame in by_frame:
            rows[frame - ids[0]] = read(by_frame[frame])
    return rows


def _read_hand(
    file: Path, raw: Any, side: Side, ids: np.ndarray, notes: list[str]
) -> HandTrack:
    by_frame = _require_dict(file, "raw_mano", raw)

    def read(entry: Any) -> np.ndarray:
        parts = []
        for name, size in HAND_FIELDS.items():
            key = f"{PREFIX[side]}__{name}"
            if not isinstance(entry, dict) or key not in entry:
                raise DemoError(f"{file}: E_KEYS: raw_mano lacks {key} in a frame.")
            parts.append(to_array(entry[key], size, what=f"{file}: {key}"))
        return np.concatenate(parts)

    rows = _rows(by_frame, ids, read, sum(HAND_FIELDS.values()))
    if np.isnan(rows).all():
        raise DemoError(f"{file}: E_KEYS: raw_mano has none of the mocap ids.")
    quats = rows[:, :64].reshape(-1, NUM_JOINTS, 4)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    off = np.abs(norms - 1) > QUAT_TOLERANCE
    if off.any():
        notes.append(f"E_ROT: {side} hand: {off.sum()} quaternions made unit")
    return HandTrack(quats, rows[:, 64:67], rows[:, 67:])


ANNOTATIONS, PROGRAMS = "anno_preview", "program/program_info"
MESH_SUFFIXES = (".obj", ".ply")
OBJECT_ID = re.compile(r"\w[\w@.+-]*")  # such as O02@0206@00001


@dataclass(frozen=True, kw_only=True)
class OakInk2Sequence:
    """Where one sequence lies.

    Attributes:
        root: of the dataset.
        token: ``scene_..++...``, the name of its files.
        mesh_folders: that hold a folder for each object, best first.
        mano: folder of the hand model.
    """

    root: Path
    token: str
    mesh_folders: tuple[Path, ...]
    mano: Path

    @property
    def annotation(self) -> Path:
        """Hands and objects."""
        return self.root / ANNOTATIONS / f"{self.token}.pkl"

    @property
    def program(self) -> Path:
        """Primitives; it may be missing."""
        return self.root / PROGRAMS / f"{self.token}.json"

    def mesh_file(self, name: str) -> Path:
        """The one mesh of an object.

        Raises:
            DemoError: no mesh, several, or the id is not a plain name.
        """
        if not OBJECT_ID.fullmatch(name):
            raise DemoError(
                f"{self.token}: E_KEYS: object id {name!r} is not a plain name."
            )
        for folder in (place / name for place in self.mesh_folders):
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            meshes = [file for file in files if file.suffix in MESH_SUFFIXES]
            if len(meshes) > 1:
                raise DemoError(
                    f"{folder}: E_FILE: {len(meshes)} meshes; expected one (.obj or "
                    f".ply). Move the others away."
                )
            if meshes:
                return meshes[0]
        sought = ", ".join(str(place) for place in self.mesh_folders)
        raise DemoError(
            f"{self.token}: E_FILE: no mesh of object {name!r}. Sought in {sought}. "
            f"Download object_repair or object_raw, or name a folder with --models."
        )
