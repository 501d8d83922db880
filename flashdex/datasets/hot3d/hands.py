"""Hand keypoints of a HOT3D sequence: by MANO where its models are given, or UmeTrack.

MANO: 15 PCA coefficients with the mean pose, ``wrist_xform`` holds the root rotation
and a translation t that is *not* the wrist: the wrist is J0(betas) + t. Releases
differ in whether the left model's shape error was fixed when the hands were fitted;
both variants are compared with the left wrist of the UmeTrack fit, and the closer one
is taken.

UmeTrack: a profile (``umetrack_hand_user_profile.json``) holds a chain of 22 hinges and
21 landmarks in mm, at rest, for a *left* hand with the wrist at the origin. Joint j
turns by ``joint_angles[j]`` about its rest axis through its rest position, after its
parent. A joint with frame index b > 1 moves bone b; bones 0 and 1 stay with the wrist.
A landmark moves rigidly with the first of its bones. The right hand is the mirror
image: the first column of its wrist rotation is negated. Landmarks come in an order of
their own (five tips, wrist, two of the thumb, three a finger, palm centre) and have no
thumb CMC. It is filled with the origin of the hinge that moves the landmark of the
thumb's MCP: the second of the two hinges at the base of the thumb, about 5 cm from the
wrist and 3 cm from the MCP.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import ManoModel, load_mano
from flashdex.datasets.fields import numbers, part, require
from flashdex.datasets.files import read_json
from flashdex.datasets.hot3d.files import WRIST, FrameAxis, Track, read_hands
from flashdex.datasets.tracks import missing_frames, rotation
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
    seen = np.isfinite(rows).all(axis=1)
    betas = np.median(rows[seen][:, BETAS], axis=0) if seen.any() else None
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


MILLIMETRE = 1e-3
NONE = 255  # no parent, no frame
ROOT_BONES = 1  # bones up to this one stay with the wrist
NUM_LANDMARKS = 21
THUMB_MCP = 6  # landmark
# the landmark of each keypoint (wrist, then thumb to pinky); the CMC has none
THUMB_CMC = -1
ORDER = (5, THUMB_CMC, 6, 7, 0, 8, 9, 10, 1, 11, 12, 13, 2, 14, 15, 16, 3)
ORDER = (*ORDER, 17, 18, 19, 4)
KEYS = (
    "joint_rotation_axes",
    "joint_rest_positions",
    "joint_parent",
    "joint_frame_index",
    "landmark_rest_positions",
    "landmark_rest_bone_indices",
)


@dataclass(frozen=True)
class UmeTrackHand:
    """A hand of one person, at rest."""

    axes: np.ndarray  # of the hinges, unit, (J, 3)
    origins: np.ndarray  # of the hinges, m, (J, 3)
    parents: np.ndarray  # earlier hinge before each, -1 at the wrist, (J,)
    points: np.ndarray  # keypoints in the 21-order, m, (21, 3)
    movers: np.ndarray  # the hinge that moves each keypoint, -1 for the wrist, (21,)

    def keypoints(
        self, angles: np.ndarray, wrist: np.ndarray, side: Side
    ) -> np.ndarray:
        """Keypoints in the 21-order, m, world, (T, 21, 3); NaN where an input is.

        Of angles of the hinges, rad, (T, J), and wrist position (m) and quaternion wxyz
        in the world, (T, 7).
        """
        seen = ~missing_frames(angles, wrist)
        out = np.full((len(angles), len(self.points), 3), np.nan)
        if seen.any():
            turn = rotation(wrist[seen, 3:]).as_matrix()
            if side == "right":
                turn[:, :, 0] *= -1
            local = self._local(angles[seen])
            out[seen] = local @ turn.transpose(0, 2, 1) + wrist[seen, None, :3]
        return out

    def _local(self, angles: np.ndarray) -> np.ndarray:
        turns, shifts = self._chain(angles)
        out = np.repeat(self.points[None], len(angles), axis=0)
        for point, mover in enumerate(self.movers.tolist()):
            if mover >= 0:
                out[:, point] = turns[mover] @ self.points[point] + shifts[mover]
        return out

    def _chain(self, angles: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Per hinge: rotation (T, 3, 3) and translation (T, 3) from rest."""
        turns: list[np.ndarray] = []
        shifts: list[np.ndarray] = []
        for joint, parent in enumerate(self.parents.tolist()):
            axis, origin = self.axes[joint], self.origins[joint]
            turn = Rotation.from_rotvec(angles[:, joint, None] * axis).as_matrix()
            shift = origin - turn @ origin
            if parent >= 0:
                shift = np.einsum("tij,tj->ti", turns[parent], shift) + shifts[parent]
                turn = turns[parent] @ turn
            turns.append(turn)
            shifts.append(shift)
        return turns, shifts


def load_umetrack(file: Path) -> UmeTrackHand:
    """Read a hand profile."""
    if not file.exists():
        raise DemoError(
            f"{file}: not found. It holds the hand's bones, which are needed without "
            f"MANO. Download the hand data of the sequence, or give --mano."
        )
    fault = "not a hand profile, JSON with 'hand_model'"
    model = part(read_json(file, fault), "hand_model", where=f"{file}: {fault}")
    where = f"{file}: hand_model"
    require(model, *KEYS, where=where)
    arrays = {key: numbers(model[key], what=f"{where}.{key}") for key in KEYS}
    if wrong := [key for key in KEYS if not np.isfinite(arrays[key]).all()]:
        raise DemoError(f"{where}: {', '.join(wrong)} hold NaN or infinity.")
    joints = arrays["joint_parent"].size
    shapes = dict.fromkeys(KEYS[:2], (joints, 3))
    shapes |= dict.fromkeys(KEYS[4:], (NUM_LANDMARKS, 3))
    shapes |= dict.fromkeys(KEYS[2:4], (joints,))
    for key, shape in shapes.items():
        if arrays[key].shape != shape:
            raise DemoError(
                f"{file}: hand_model.{key} has shape {arrays[key].shape}, expected "
                f"{shape}. Download the hand data of the sequence again."
            )
    return _build(arrays, file)


def _build(arrays: dict[str, np.ndarray], file: Path) -> UmeTrackHand:
    axes, origins, parents, frames, rest, bones = (arrays[key] for key in KEYS)
    parents = np.where(parents == NONE, -1, parents).astype(int)
    if (parents >= np.arange(len(parents))).any():
        raise DemoError(f"{file}: hand_model.joint_parent must name earlier joints.")
    moving = (frames > ROOT_BONES) & (frames < NONE)
    joint_of = {int(frames[joint]): int(joint) for joint in np.flatnonzero(moving)}
    wanted = bones[:, 0].astype(int)
    unknown = sorted({int(b) for b in wanted if b > ROOT_BONES} - set(joint_of))
    if unknown:
        raise DemoError(f"{file}: no joint moves bones {unknown}, but landmarks do.")
    movers = np.array([joint_of.get(int(bone), -1) for bone in wanted])
    base, order = int(movers[THUMB_MCP]), np.array(ORDER)
    filled = order == THUMB_CMC
    return UmeTrackHand(
        axes=axes,
        origins=origins * MILLIMETRE,
        parents=parents,
        points=np.where(filled[:, None], origins[base], rest[order]) * MILLIMETRE,
        movers=np.where(filled, base, movers[order]),
    )
