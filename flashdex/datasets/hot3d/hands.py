"""Hand keypoints of a HOT3D sequence: by MANO where its models are given, or UmeTrack.

MANO: 15 PCA coefficients with the mean pose, ``wrist_xform`` holds the root rotation
and a translation t that is *not* the wrist: the wrist is J0(betas) + t. Releases
differ in whether the left model's shape error was fixed when the hands were fitted;
both variants are compared with the left wrist of the UmeTrack fit, and the closer one
is taken.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.body_models.mano import ManoModel, load_mano
from flashdex.datasets.body_models.umetrack import load_umetrack
from flashdex.datasets.hot3d.files import WRIST, FrameAxis, Track, read_hands
from flashdex.datasets.tracks import rotation
from flashdex.errors import DemoError
from flashdex.keys import Side

MANO_FILE = "mano_hand_pose_trajectory.jsonl"
UMETRACK_FILE = "umetrack_hand_pose_trajectory.jsonl"
PROFILE_FILE = "umetrack_hand_user_profile.json"
MANO_FIELDS = {"pose": 15, "betas": 10}
UMETRACK_FIELDS = {"joint_angles": 22}
POSE = slice(WRIST, WRIST + 15)
BETAS = slice(WRIST + 15, WRIST + 25)

Hands = dict[Side, np.ndarray]


def read_keypoints(
    folder: Path, axis: FrameAxis, mano: Path | None, *, allowed: np.ndarray
) -> tuple[Hands, dict[str, Any]]:
    """Keypoints on the frames of a sequence, and entries for the provenance.

    By the MANO models of a folder; without one by UmeTrack. Per recorded hand
    (T, 21, 3), m, world, NaN where it was not tracked or not ``allowed`` (T,).
    """
    if mano is None:
        hands, notes = _read_umetrack(folder, axis)
    else:
        hands, notes = _read_mano(folder, axis, mano)
    for track in hands.values():
        track[~allowed] = np.nan
    seen: Hands = {s: k for s, k in hands.items() if np.isfinite(k[:, 0, 0]).any()}
    counts = {side: int(np.isfinite(k[:, 0, 0]).sum()) for side, k in seen.items()}
    notes["hand_frames"] = counts
    if not seen:
        raise DemoError(f"{folder.name}: no hand is tracked in any valid frame.")
    return seen, notes


def _read_umetrack(folder: Path, axis: FrameAxis) -> tuple[Hands, dict[str, Any]]:
    model = load_umetrack(folder / PROFILE_FILE)
    hands: Hands = {}
    for side, track in read_hands(folder / UMETRACK_FILE, UMETRACK_FIELDS).items():
        rows = axis.sample(track)
        hands[side] = model.keypoints(rows[:, WRIST:], rows[:, :WRIST], side)
    return hands, {"keypoints": "umetrack"}


def _read_mano(
    folder: Path, axis: FrameAxis, mano: Path
) -> tuple[Hands, dict[str, Any]]:
    tracks = read_hands(folder / MANO_FILE, MANO_FIELDS)
    wrists = _umetrack_wrists(folder, axis)
    notes: dict[str, Any] = {"keypoints": "mano"}
    hands: Hands = {}
    for side, track in tracks.items():
        rows = axis.sample(track)
        model = load_mano(mano, side)
        if side == "left":
            model, notes["left_shape"] = _choose_left(mano, rows, wrists.get("left"))
        hands[side] = mano_keypoints(model, rows)
    notes["umetrack_wrist_gap_mm"] = {
        side: gap
        for side, points in hands.items()
        if (gap := _gap_mm(points[:, 0], wrists.get(side))) is not None
    }
    return hands, notes


def mano_keypoints(model: ManoModel, rows: np.ndarray) -> np.ndarray:
    """Keypoints (T, 21, 3), m, world, of rows (T, 32): t, q_wxyz, pose, betas."""
    out = np.full((len(rows), 21, 3), np.nan)
    seen = np.isfinite(rows).all(axis=1)
    for betas in np.unique(rows[seen][:, BETAS], axis=0):  # one, in all known files
        group = seen & (rows[:, BETAS] == betas).all(axis=1)
        root = rotation(rows[group, 3:WRIST]).as_rotvec()
        fingers = model.finger_pose(rows[group, POSE], flat=False)
        out[group] = model.keypoints_of(
            root,
            fingers,
            rows[group, :3],
            betas=betas,
            convention="joint",
            where="hand poses",
        )
    return out


def _choose_left(
    mano: Path, rows: np.ndarray, wrist: np.ndarray | None
) -> tuple[ManoModel, dict[str, Any]]:
    """The left model whose wrist, J0(betas) + t, is nearer to the UmeTrack wrist.

    Rows of the left hand (T, 32), its wrist by UmeTrack, m, (T, 3), NaN where it was
    not tracked. As fixed where nothing can be compared, which is what the dataset's own
    code does.
    """
    fixed = load_mano(mano, "left", fix_left_shape=True)
    raw = load_mano(mano, "left", fix_left_shape=False)
    if not fixed.left_shape_fixed:
        return raw, {"fixed": False, "why": "the model file has no sign error"}
    betas = _middle_shape(rows)
    gaps = [_gap_mm(m.rest_wrist(betas) + rows[:, :3], wrist) for m in (fixed, raw)]
    if gaps[0] is None or gaps[1] is None:
        return fixed, {"fixed": True, "why": "default: no UmeTrack wrist to compare"}
    take_fixed = gaps[0] <= gaps[1]
    return fixed if take_fixed else raw, {
        "fixed": take_fixed,
        "why": "nearer to the UmeTrack wrist",
        "gap_fixed_mm": gaps[0],
        "gap_raw_mm": gaps[1],
    }


def _middle_shape(rows: np.ndarray) -> np.ndarray | None:
    seen = np.isfinite(rows).all(axis=1)
    return np.median(rows[seen][:, BETAS], axis=0) if seen.any() else None


def _gap_mm(points: np.ndarray, wrist: np.ndarray | None) -> float | None:
    """Median distance, mm, of two tracks (T, 3) over the frames that both have."""
    if wrist is None:
        return None
    gaps = np.linalg.norm(points - wrist, axis=1)
    gaps = gaps[np.isfinite(gaps)]
    return round(float(np.median(gaps)) * 1e3, 1) if len(gaps) else None


def _umetrack_wrists(folder: Path, axis: FrameAxis) -> Hands:
    """Wrist positions (T, 3) by UmeTrack; empty where the file is absent."""
    file = folder / UMETRACK_FILE
    tracks: dict[Side, Track] = read_hands(file, {}) if file.is_file() else {}
    return {side: axis.sample(track)[:, :3] for side, track in tracks.items()}
