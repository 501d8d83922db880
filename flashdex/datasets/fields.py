"""Entries of a file as what they should be: numbers, texts, tracks, poses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.tracks import blank_fillers, continuous, missing_frames, to_quat
from flashdex.errors import DemoError

ROTATION_TOLERANCE = 1e-3  # of |R^T R - I|; float32 matrices stay below 1e-6
MAX_NUMBERS = 1 << 25  # of one entry of a file; an hour of a hand at 120 Hz is less
LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def numbers(value: Any, *, what: str) -> np.ndarray:
    """Real numbers of any shape, float64, of an array, a tensor, a list, ...

    A ``DemoError`` that names ``what`` (file and key) for anything else, and for rows
    of different lengths.
    """
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"it holds {array.dtype}")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        told = " ".join(str(error).split())[:120]
        text = f"{what}: not numbers but a {type(value).__name__}: {told}."
        raise DemoError(text, code="E_KEYS") from error
    if array.size > MAX_NUMBERS:  # a view of few may say that it is many
        text = f"{what}: {array.size} numbers; at most {MAX_NUMBERS} are read."
        raise DemoError(text, code="E_KEYS")
    return array.astype(np.float64)


def number(value: Any, *, what: str) -> float:
    """One real number, in an array of any rank or alone."""
    array = numbers(value, what=what)
    if array.size != 1:
        text = f"{what}: shape {array.shape}; expected one number."
        raise DemoError(text, code="E_KEYS")
    return float(array.reshape(()))


def to_array(value: Any, size: int, *, what: str) -> np.ndarray:
    """Numbers of known count, flat, (size,); axes of length one do not matter."""
    array = numbers(value, what=f"{what}, expected {size} numbers")
    if array.size != size:
        text = f"{what}: shape {array.shape}; expected {size} numbers."
        raise DemoError(text, code="E_KEYS")
    return array.reshape(size)


def row(
    data: Any, sizes: Mapping[str, int], *, where: str, file: str = ""
) -> np.ndarray:
    """Entries of a table, each with its count of numbers, one after the other."""
    parts = [
        to_array(part(data, key, where=where), size, what=f"{file or where}: {key}")
        for key, size in sizes.items()
    ]
    return np.concatenate(parts)


def words(value: Any) -> list[str]:
    """All texts of an array of any rank, or of one that stands alone.

    Bytes are texts in UTF-8: numpy and HDF5 store them so.
    """
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    values = value if isinstance(value, (list, tuple)) else [value]
    return [
        v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values
    ]


def word(value: Any, *, what: str) -> str:
    """One text, in an array of any rank or alone."""
    found = words(value)
    if len(found) != 1:
        text = f"{what}: {len(found)} entries; expected one text."
        raise DemoError(text, code="E_KEYS")
    return found[0]


def require(data: Any, *keys: str, where: str) -> None:
    """Refuse a table that lacks a key; the message shows what is there."""
    known = data if isinstance(data, Mapping) else {}
    if missing := [key for key in keys if key not in known]:
        found = ", ".join(map(str, known)) or f"a {type(data).__name__}"
        text = f"{where}: lacks {', '.join(missing)}. Found: {found[:200]}."
        raise DemoError(text, code="E_KEYS")


def part(data: Any, key: str, *, where: str) -> Any:
    """One entry of a table."""
    require(data, key, where=where)
    return data[key]


def track(data: Any, key: str, *shape: int, where: str) -> np.ndarray:
    """One track of a table, (T, *shape) float64, T at least 1; else a ``DemoError``."""
    values = numbers(part(data, key, where=where), what=f"{where}: {key}")
    if not len(np.atleast_1d(values)) or values.shape[1:] != shape or not values.ndim:
        told = ", ".join(["T", *map(str, shape)])
        text = f"{where}: {key} has shape {values.shape}; expected ({told})."
        raise DemoError(text, code="E_KEYS")
    return values


def same_length(lengths: Mapping[str, int], *, where: str) -> int:
    """The number of frames that all tracks have; a ``DemoError`` where they differ."""
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {count}" for name, count in lengths.items())
        text = f"{where}: frames differ: {told}. Get the file anew."
        raise DemoError(text, code="E_LEN")
    return next(iter(lengths.values()))


def pose_track(turns: Rotation, positions: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Position and quaternion wxyz without sign flips, (T, 7).

    ``turns`` are those of the ``seen`` frames (T,), ``positions`` (m, (T, 3)) of all;
    the others become NaN.
    """
    pose = np.full((len(positions), 7), np.nan)
    if seen.any():
        pose[seen, :3] = positions[seen]
        pose[seen, 3:] = continuous(to_quat(turns))
    return pose


def poses_from_matrices(
    matrices: np.ndarray, *, what: str
) -> tuple[np.ndarray, list[str]]:
    """Rigid transforms T_world_object, m, (T, 4, 4), as positions and quaternions.

    Returns:
        Position (m) and quaternion wxyz without sign flips, (T, 7), NaN where a matrix
        is not finite; and a note if rotations had to be made orthonormal.

    Raises:
        DemoError: wrong shape, a transposed transform, or a reflection.
    """
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        text = f"{what}: shape {matrices.shape}; expected (T, 4, 4) transforms."
        raise DemoError(text, code="E_KEYS")
    matrices = blank_fillers(matrices)
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


def _refuse(bad: np.ndarray, frames: np.ndarray, what: str, fault: str) -> None:
    if bad.any():
        raise DemoError(
            f"{what}: frame {frames[bad][0]} is not a rigid transform: its {fault} is "
            f"wrong. Expected a rotation (determinant 1) and a position in the last "
            f"column; the last row is 0 0 0 1.",
            code="E_ROT",
        )
