"""Entries of a file as what they should be: numbers, one number, one text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.tracks import continuous, missing_frames, to_quat
from flashdex.errors import DemoError


def numbers(value: Any, *, what: str) -> np.ndarray:
    """Real numbers of any shape, float64.

    Args:
        value: an array, a tensor, a list, or anything else.
        what: file and key, for the message.

    Raises:
        DemoError: it holds something else, or rows of different lengths.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"it holds {array.dtype}")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        told = " ".join(str(error).split())[:120]
        raise DemoError(f"{what}: E_KEYS: not numbers: {told}.") from error
    return array.astype(np.float64)


def number(value: Any, *, what: str) -> float:
    """One real number, in an array of any rank or alone.

    Raises:
        DemoError: it is something else.
    """
    array = numbers(value, what=what)
    if array.size != 1:
        raise DemoError(f"{what}: E_KEYS: shape {array.shape}; expected one number.")
    return float(array.reshape(()))


def words(value: Any) -> list[str]:
    """All texts of an array of any rank, or of one that stands alone."""
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    return [str(v) for v in value] if isinstance(value, (list, tuple)) else [str(value)]


def word(value: Any, *, what: str) -> str:
    """One text, in an array of any rank or alone.

    Raises:
        DemoError: there are none or several.
    """
    found = words(value)
    if len(found) != 1:
        raise DemoError(f"{what}: E_KEYS: {len(found)} entries; expected one text.")
    return found[0]


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


def track(data: Any, key: str, width: int, *, where: str) -> np.ndarray:
    """One track of a table, (T, width) float64.

    Args:
        data: the table: a mapping of names to arrays.
        key: of the track.
        width: numbers a frame.
        where: file and part of it, for messages.

    Raises:
        DemoError: the key is missing or its shape is another one.
    """
    stored = part(data, key, where=where)
    try:
        values = np.asarray(stored, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DemoError(f"{where}: {key} holds no numbers (E_KEYS).") from error
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise DemoError(
            f"{where}: {key} has shape {values.shape}; expected (T, {width}) (E_KEYS)."
        )
    return values


def part(data: Any, key: str, *, where: str) -> Any:
    """One entry of a table, whatever it is.

    Raises:
        DemoError: the key is missing.
    """
    if not isinstance(data, Mapping) or key not in data:
        kind = type(data).__name__
        found = ", ".join(map(str, data)) if isinstance(data, Mapping) else f"a {kind}"
        raise DemoError(f"{where}: lacks {key} (E_KEYS). Found: {found}.")
    return data[key]


def same_length(lengths: Mapping[str, int], *, where: str) -> int:
    """The number of frames that all tracks have.

    Raises:
        DemoError: they differ.
    """
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise DemoError(f"{where}: frames differ: {told} (E_LEN). Get the file anew.")
    return next(iter(lengths.values()))
