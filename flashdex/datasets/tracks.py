"""Tracks over time: palm frame, resampling, velocities, smoothing (numpy, float64)."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from flashdex.keys import Side

VELOCITY_SIGMA = 2.0  # frames, of the Gaussian over velocities (method.md 14)
# m; a number beyond is no position, and its square may not be a number at all
FARTHEST = 1e6
MARK_SPREAD = 1e-6  # of the entries of a frame; below, they are all the same


def rotation(quat: np.ndarray) -> Rotation:
    """Scipy rotation of quaternions (..., 4), wxyz."""
    return Rotation.from_quat(quat, scalar_first=True)


def to_quat(rot: Rotation) -> np.ndarray:
    """Quaternions (..., 4), wxyz, of a scipy rotation."""
    return rot.as_quat(scalar_first=True)


def continuous(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions (T, 4) without sign flips; the first one has w >= 0."""
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    dots = np.einsum("ti,ti->t", quats[1:], quats[:-1])
    first = 1.0 if quats[0, 0] >= 0 else -1.0
    signs = np.concatenate([[first], np.where(dots < 0, -1.0, 1.0)])
    return quats * np.cumprod(signs)[:, None]


def palm_frame(keypoints: np.ndarray, side: Side) -> np.ndarray:
    """Geometric palm pose of keypoints.

    x = unit(middle MCP - wrist); z out of the palm, n = (index MCP - wrist) x (pinky
    MCP - wrist) with operands swapped for the left hand, made orthogonal to x;
    y = z x x.

    Of keypoints in m, world, (T, 21, 3): wrist position and quaternion wxyz, (T, 7);
    NaN in frames with NaN, and where the points span no palm: zeros stand for a
    missing hand in many files.
    """
    pose = np.full((len(keypoints), 7), np.nan)
    seen = np.asarray((np.abs(keypoints) < FARTHEST).all(axis=(1, 2)))
    points = np.where(seen[:, None, None], keypoints, np.nan)
    wrist, index, middle, pinky = (points[:, i] for i in (0, 5, 9, 17))
    x = _unit(middle - wrist)
    normal = np.cross(index - wrist, pinky - wrist)
    normal = normal if side == "right" else -normal
    z = _unit(normal - np.sum(normal * x, -1, keepdims=True) * x)
    matrix = np.stack([x, np.cross(z, x), z], axis=-1)
    seen[seen] = np.linalg.det(matrix[seen]) > 0.5
    if seen.any():
        pose[seen, :3] = wrist[seen]
        pose[seen, 3:] = continuous(to_quat(Rotation.from_matrix(matrix[seen])))
    return pose


def sample_times(num_frames: int, fps: float, target_fps: float) -> np.ndarray:
    """Times of the resampled frames, s: from 0 to the last that the track covers."""
    last = (num_frames - 1) / fps
    return np.arange(int(np.floor(last * target_fps + 1e-6)) + 1) / target_fps


def resample(values: np.ndarray, fps: float, times: np.ndarray) -> np.ndarray:
    """Linear interpolation of a track (T, ...) at ``times`` (s)."""
    index = np.clip(times * fps, 0, len(values) - 1)
    low = np.minimum(index.astype(int), len(values) - 2)
    part = (index - low).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - part) * values[low] + part * values[low + 1]


def resample_pose(pose: np.ndarray, fps: float, times: np.ndarray) -> np.ndarray:
    """Linear positions and slerped quaternions of a pose track (T, 7) at ``times``."""
    slerp = Slerp(np.arange(len(pose)) / fps, rotation(continuous(pose[:, 3:])))
    quats = continuous(to_quat(slerp(np.clip(times, 0, (len(pose) - 1) / fps))))
    return np.concatenate([resample(pose[:, :3], fps, times), quats], axis=-1)


def linear_velocity(
    values: np.ndarray, fps: float, *, sigma: float = VELOCITY_SIGMA
) -> np.ndarray:
    """Smoothed central differences, (x_{t+1} - x_{t-1}) fps / 2; one-sided at the ends.

    Of a track (T, ...); ``sigma`` of the Gaussian in frames, 0 for none.
    """
    speed = np.gradient(values, 1.0 / fps, axis=0)
    return gaussian_filter1d(speed, sigma, axis=0, mode="nearest") if sigma else speed


def angular_velocity(
    quats: np.ndarray, fps: float, *, sigma: float = VELOCITY_SIGMA
) -> np.ndarray:
    """Rotation rate in the world, log(R_{t+1} R_{t-1}^T) fps / 2, smoothed; rad/s.

    Of quaternions wxyz, (T, 4); ``sigma`` as in ``linear_velocity``.
    """
    after = np.minimum(np.arange(len(quats)) + 1, len(quats) - 1)
    before = np.maximum(np.arange(len(quats)) - 1, 0)
    turns = (rotation(quats[after]) * rotation(quats[before]).inv()).as_rotvec()
    speed = turns * fps / (after - before)[:, None]
    return gaussian_filter1d(speed, sigma, axis=0, mode="nearest") if sigma else speed


def transform_pose(pose: np.ndarray, rot: Rotation) -> np.ndarray:
    """A pose track (T, 7) seen from a world turned by ``rot``."""
    quats = to_quat(rot * rotation(pose[:, 3:]))
    return np.concatenate([rot.apply(pose[:, :3]), quats], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-9)


GAP_SECONDS = 0.1  # a longer gap is never closed
LEAST_GAP = 2  # frames that are closed at any rate, at low frame rates


def missing_frames(*tracks: np.ndarray) -> np.ndarray:
    """Frames in which any value of tracks (T, ...) is NaN or infinite, (T,) bool."""
    sound = [np.isfinite(t).all(axis=tuple(range(1, t.ndim))) for t in tracks]
    return ~np.logical_and.reduce(sound)


def blank_fillers(track: np.ndarray) -> np.ndarray:
    """A track with NaN in frames that hold a mark in place of numbers.

    Data sets write zeros, or -1, or another number, where nothing was tracked: a frame
    of poses (T, 7), transforms (T, 4, 4) or keypoints (T, 21, 3) whose entries are all
    the same, or whose quaternion is zero; and a single joint or tip of such entries (a
    wrist may be the origin of a hand's own frame). Other shapes stay as they are.
    """
    if track.ndim == 3 and track.shape[2] == 3 and track.size:
        single = np.ptp(track, axis=2) < MARK_SPREAD
        single[:, 0] = single[:, 1:].all(axis=1)
        return np.where(single[..., None], np.nan, track) if single.any() else track
    if track.ndim == 3 and track.size:
        spread = np.ptp(track, axis=(1, 2))
    elif track.ndim == 2 and track.shape[1] == 7 and len(track):
        no_turn = np.abs(track[:, 3:]).max(axis=1)
        spread = np.minimum(np.ptp(track, axis=1), no_turn)
    else:
        return track
    marked = spread < MARK_SPREAD  # NaN compares as False
    if not marked.any():
        return track
    return np.where(marked.reshape(-1, *[1] * (track.ndim - 1)), np.nan, track)


def short_gaps(missing: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Runs of missing frames (T,) of at most 0.1 s (start, end excluded) inside it."""
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
    """A copy of a pose track (T, 7) without sign flips, and how many it had."""
    tracked = ~missing_frames(pose)
    if not tracked.any():
        return pose.copy(), 0
    quats = pose[tracked, 3:]
    flips = int((np.sum(quats[1:] * quats[:-1], axis=-1) < 0).sum())
    pose = pose.copy()
    pose[tracked, 3:] = continuous(quats)
    return pose, flips


def same_track(one: np.ndarray, other: np.ndarray, *, atol: float = 1e-8) -> bool:
    """Whether two tracks (T, ...) tell the same, NaN included."""
    same_shape = one.shape == other.shape
    return same_shape and np.allclose(one, other, atol=atol, equal_nan=True)


def runs(mask: np.ndarray, *, least: int = 1) -> list[tuple[int, int]]:
    """Maximal runs of True in ``mask`` (T,) of at least ``least`` frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(a, b) for a, b in pairs if b - a >= least]
