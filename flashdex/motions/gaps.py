"""Frames in which a track is missing: find them, and close short gaps."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Slerp

from flashdex.motions.support import runs
from flashdex.motions.tracks import continuous, rotation, to_quat

GAP_SECONDS = 0.1  # a longer gap is never closed
LEAST_GAP = 2  # frames that are closed at any rate, at low frame rates


def missing_frames(*tracks: np.ndarray) -> np.ndarray:
    """Frames in which any value of tracks (T, ...) is NaN or infinite, (T,) bool."""
    sound = [np.isfinite(t).all(axis=tuple(range(1, t.ndim))) for t in tracks]
    return ~np.logical_and.reduce(sound)


def short_gaps(missing: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Runs of missing frames of at most 0.1 s (start, end excluded) inside a track.

    Args:
        missing: (T,) bool.
        fps: frames a second.
    """
    limit = max(int(GAP_SECONDS * fps + 1e-6), LEAST_GAP)
    gaps = [(a, b) for a, b in runs(missing) if b - a <= limit]
    return [(a, b) for a, b in gaps if a > 0 and b < len(missing)]


def fill_points(values: np.ndarray, gaps: list[tuple[int, int]]) -> np.ndarray:
    """A copy of a track (T, ...) that is linear over the gaps (start, end excluded)."""
    values = values.copy()
    for start, end in gaps:
        part = _parts(start, end).reshape(-1, *[1] * (values.ndim - 1))
        values[start:end] = (1 - part) * values[start - 1] + part * values[end]
    return values


def fill_pose(pose: np.ndarray, gaps: list[tuple[int, int]]) -> np.ndarray:
    """A copy of a pose track (T, 7): linear positions and slerp over the gaps."""
    filled = fill_points(pose, gaps)
    for start, end in gaps:
        slerp = Slerp([0, 1], rotation(pose[[start - 1, end], 3:]))
        filled[start:end, 3:] = to_quat(slerp(_parts(start, end)))
    return filled


def _parts(start: int, end: int) -> np.ndarray:
    """Where the frames of a gap lie between its neighbours, in 0..1."""
    return np.arange(1, end - start + 1) / (end - start + 1)


def align_signs(pose: np.ndarray) -> tuple[np.ndarray, int]:
    """Unit quaternions without sign flips in the tracked frames.

    Args:
        pose: (T, 7), NaN where not tracked.

    Returns:
        A new track, and how many flips there were.
    """
    tracked = ~missing_frames(pose)
    if not tracked.any():
        return pose.copy(), 0
    quats = pose[tracked, 3:]
    flips = int((np.sum(quats[1:] * quats[:-1], axis=-1) < 0).sum())
    pose = pose.copy()
    pose[tracked, 3:] = continuous(quats)
    return pose, flips
