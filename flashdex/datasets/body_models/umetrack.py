"""Forward kinematics of UmeTrack hands: the MANO-free hand poses of HOT3D.

A profile (``umetrack_hand_user_profile.json``) holds a chain of 22 hinges and 21
landmarks in mm, at rest, for a *left* hand with the wrist at the origin. Joint j turns
by ``joint_angles[j]`` about its rest axis through its rest position, after its parent.
A joint with frame index b > 1 moves bone b; bones 0 and 1 stay with the wrist. A
landmark moves rigidly with the first of its bones. The right hand is the mirror image:
the first column of its wrist rotation is negated.

Landmarks come in an order of their own (five tips, wrist, two of the thumb, three a
finger, palm centre) and have no thumb CMC. It is filled with the origin of the hinge
that moves the landmark of the thumb's MCP: the second of the two hinges at the base of
the thumb, about 5 cm from the wrist and 3 cm from the MCP.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.fields import numbers, part, require
from flashdex.datasets.files import read_json
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.errors import DemoError
from flashdex.keys import Side

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
    # hinge before each, -1 at the wrist, (J,); always an earlier one
    parents: np.ndarray
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
        """Keypoints in the wrist's frame of the left hand, m, (T, 21, 3)."""
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
    joint_of = {
        int(bone): joint
        for joint, bone in enumerate(frames)
        if ROOT_BONES < bone < NONE
    }
    wanted = bones[:, 0].astype(int)
    unknown = sorted({int(b) for b in wanted if b > ROOT_BONES} - set(joint_of))
    if unknown:
        raise DemoError(f"{file}: no joint moves bones {unknown}, but landmarks do.")
    movers = np.array([joint_of.get(int(bone), -1) for bone in wanted])
    base = int(movers[THUMB_MCP])
    return UmeTrackHand(
        axes=axes,
        origins=origins * MILLIMETRE,
        parents=parents,
        points=np.stack(
            [origins[base] if mark == THUMB_CMC else rest[mark] for mark in ORDER]
        )
        * MILLIMETRE,
        movers=np.array(
            [base if mark == THUMB_CMC else movers[mark] for mark in ORDER]
        ),
    )
