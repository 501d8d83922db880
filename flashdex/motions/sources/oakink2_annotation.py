"""The annotation of an OakInk2 sequence, ``anno_preview/<token>.pkl``, as tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side
from flashdex.motions.demo import QUAT_TOLERANCE
from flashdex.motions.sources.oakink2_program import PREFIX
from flashdex.motions.sources.rigid import poses_from_matrices, to_array
from flashdex.motions.unpickle import load_pickle

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
