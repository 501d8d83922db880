"""Velocities of a motion: they follow from its positions, and are checked against them.

Angular velocities are of the world frame; all are smoothed central differences, see
``datasets.tracks``. Nobody chooses them: what is stored otherwise was not prepared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from flashdex.datasets.tracks import (
    VELOCITY_SIGMA,
    angular_velocity,
    linear_velocity,
)
from flashdex.geometry.rotation import quat_conj, quat_mul, quat_to_rotvec

Arrays = Mapping[str, np.ndarray]
SOURCES = {
    "joint_vel": "joint_pos",
    "wrist_linvel": "wrist_pos",
    "wrist_angvel": "wrist_quat",
    "keypoint_linvel": "keypoints",
    "object_linvel": "object_pos",
    "object_angvel": "object_quat",
}
TOLERANCE = 0.01  # m/s, rad/s
ROUNDING = 1e-5  # m, of the difference of two positions in float32, 100 m away
ROWS = 16_384  # frames whose turns are held in memory at once


def derive_velocities(frames: Arrays, fps: float) -> dict[str, np.ndarray]:
    """All velocities of one motion of at least two frames, (T, ...), m/s and rad/s."""
    return {key: _derive(frames[source], fps) for key, source in SOURCES.items()}


def _derive(track: np.ndarray, fps: float) -> np.ndarray:
    if track.shape[-1] != 4:
        return linear_velocity(track.astype(np.float64), fps)
    turns = [angular_velocity(track[:, i], fps) for i in range(track.shape[1])]
    return np.stack(turns, axis=1)


def find_other_velocities(
    arrays: Arrays, fps: float, seed: int
) -> Iterator[tuple[str, int, float, float]]:
    """Velocities that do not follow from the positions: the first of each array.

    All numbers of a frame are compared at once, as a sum with drawn weights; only
    motions whose sums differ are computed in full.

    Args:
        arrays: of a library, by name.
        fps: frames a second.
        seed: of the weights; not to be known to whoever made the arrays.

    Yields:
        Name, row of ``frames``, what is stored there, and what follows.
    """
    tolerance = TOLERANCE + ROUNDING * fps
    start, length = (arrays[f"motions/{key}"].tolist() for key in ("start", "length"))
    spans = [slice(s, s + n) for s, n in zip(start, length, strict=True) if n > 1]
    told, derived = _sums(arrays, spans, fps, np.random.default_rng(seed))
    for column, (key, source) in enumerate(SOURCES.items()):
        for span in spans:
            # no weight is below a half, and what differs alike hardly cancels
            gap = np.abs(told[span, column] - derived[span, column]).max()
            if gap <= tolerance / 20:
                continue
            stored = arrays[f"frames/{key}"][span]
            wanted = _derive(arrays[f"frames/{source}"][span], fps)
            gaps = np.abs(stored - wanted)
            at = np.unravel_index(int(gaps.argmax()), gaps.shape)
            if not gaps[at] <= tolerance:
                row = span.start + int(at[0])
                yield f"frames/{key}", row, float(stored[at]), float(wanted[at])
                break


def _sums(
    arrays: Arrays, spans: list[slice], fps: float, draw: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted sums of stored and of derived velocities, by frame and array, (F, K)."""
    total = len(arrays["frames/joint_pos"])
    before, after = np.arange(total) - 1, np.arange(total) + 1
    for span in spans:
        before[span.start], after[span.stop - 1] = span.start, span.stop - 1
    before, after = before.clip(0), after.clip(max=total - 1)
    rate = fps / (after - before).clip(1)
    told, derived = np.zeros((2, total, len(SOURCES)))
    for column, (key, source) in enumerate(SOURCES.items()):
        speed, track = arrays[f"frames/{key}"], arrays[f"frames/{source}"]
        shape = speed.shape[1:]
        weights = draw.uniform(0.5, 1.5, shape) * draw.choice([-1.0, 1.0], shape)
        flat = weights.ravel().astype(np.float32)
        told[:, column] = speed.reshape(total, -1) @ flat
        if track.shape[-1] == 4:
            derived[:, column] = _turns(track, before, after, weights) * rate
        else:
            place = track.reshape(total, -1) @ flat
            derived[:, column] = (place[after] - place[before]) * rate
    for span in spans:
        derived[span] = gaussian_filter1d(
            derived[span], VELOCITY_SIGMA, axis=0, mode="nearest"
        )
    return told, derived


def _turns(
    quats: np.ndarray, before: NDArray, after: NDArray, weights: np.ndarray
) -> NDArray[np.float64]:
    """Weighted sums of the rotation vectors from one frame to another, rad, (F,)."""
    sums = np.empty(len(quats))
    for first in range(0, len(quats), ROWS):
        rows = slice(first, first + ROWS)
        one, two = (torch.from_numpy(quats[i[rows]]) for i in (before, after))
        turn = quat_to_rotvec(quat_mul(two, quat_conj(one))).numpy()
        sums[rows] = turn.reshape(len(turn), -1) @ weights.ravel()
    return sums
