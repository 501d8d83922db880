"""Numbers of recordings as checked arrays: tensors, and rigid transforms as poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.errors import DemoError
from flashdex.motions.gaps import missing_frames
from flashdex.motions.tracks import continuous, to_quat

ROTATION_TOLERANCE = 1e-3  # of |R^T R - I|; float32 matrices stay below 1e-6
LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def to_array(value: Any, size: int, *, what: str) -> np.ndarray:
    """A number array or tensor of known size, flat.

    Args:
        value: anything; a tensor may need a gradient.
        size: numbers it must hold; axes of length one do not matter.
        what: file and key, for the message.

    Returns:
        (size,) float64.

    Raises:
        DemoError: it is not that.
    """
    try:
        plain = value.detach().cpu().numpy() if hasattr(value, "detach") else value
        array = np.asarray(plain, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DemoError(
            f"{what}: E_KEYS: a {type(value).__name__}; expected {size} numbers."
        ) from error
    if array.size != size:
        raise DemoError(
            f"{what}: E_KEYS: shape {array.shape}; expected {size} numbers."
        )
    return array.reshape(size)


def poses_from_matrices(
    matrices: np.ndarray, *, what: str
) -> tuple[np.ndarray, list[str]]:
    """Rigid transforms as positions and quaternions.

    Args:
        matrices: T_world_object, m, (T, 4, 4); NaN where a frame was not tracked.
        what: file or object, for messages.

    Returns:
        Position (m) and quaternion wxyz without sign flips, (T, 7), NaN where a matrix
        is not finite; and a note if rotations had to be made orthonormal.

    Raises:
        DemoError: wrong shape, a transposed transform, or a reflection.
    """
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DemoError(
            f"{what}: E_KEYS: shape {matrices.shape}; expected (T, 4, 4) transforms."
        )
    seen = ~missing_frames(matrices)
    if not seen.any():
        return np.full((len(matrices), 7), np.nan), []
    rigid = matrices[seen].astype(np.float64)
    frames, turns = np.flatnonzero(seen), rigid[:, :3, :3]
    _refuse(np.abs(rigid[:, 3] - LAST_ROW).max(-1) > 1e-3, frames, what, "last row")
    _refuse(np.linalg.det(turns) < 1e-3, frames, what, "determinant")
    errors = np.swapaxes(turns, 1, 2) @ turns - np.eye(3)
    skew = np.linalg.norm(errors, axis=(1, 2)) > ROTATION_TOLERANCE
    pose = pose_track(Rotation.from_matrix(turns), matrices[:, :3, 3], seen)
    text = f"E_ROT: {what}: {skew.sum()} rotations made orthonormal, first in frame "
    return pose, [f"{text}{frames[skew][0]}"] if skew.any() else []


def pose_track(turns: Rotation, positions: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Position and quaternion wxyz without sign flips, NaN in unseen frames, (T, 7).

    Args:
        turns: rotations of the seen frames.
        positions: m, (T, 3).
        seen: frames that were tracked, (T,).
    """
    pose = np.full((len(positions), 7), np.nan)
    if seen.any():
        pose[seen, :3] = positions[seen]
        pose[seen, 3:] = continuous(to_quat(turns))
    return pose


def _refuse(bad: np.ndarray, frames: np.ndarray, what: str, fault: str) -> None:
    if bad.any():
        raise DemoError(
            f"{what}: E_ROT: frame {frames[bad][0]} is not a rigid transform: its "
            f"{fault} is wrong. Expected a rotation (determinant 1) and a position in "
            f"the last column; the last row is 0 0 0 1."
        )
