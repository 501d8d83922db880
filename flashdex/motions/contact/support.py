"""Support surfaces from objects at rest: table height and thin discs."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.tracks import angular_velocity, linear_velocity, rotation, runs

STILL_SPEED = 0.03  # m/s
STILL_TURN = 0.3  # rad/s
STILL_SECONDS = 1 / 6
# heights closer than this are one level, m
LEVEL_GAP = 0.05
NUM_DISKS = 4
RADIUS_CLASSES = (0.08, 0.15, 0.25, 0.40)
DISK_HEIGHT = 0.01
TABLE_HEIGHT = 0.02
TABLE_MARGIN = 0.40


def still_runs(pose: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Runs of frames (start, end excluded) in which a pose track (T, 7) rests.

    Still = slower than 0.03 m/s and 0.3 rad/s for at least 1/6 s.
    """
    speed = np.linalg.norm(linear_velocity(pose[:, :3], fps, sigma=1.0), axis=-1)
    turn = np.linalg.norm(angular_velocity(pose[:, 3:], fps, sigma=1.0), axis=-1)
    least = max(int(np.ceil(STILL_SECONDS * fps)), 2)
    return runs((speed < STILL_SPEED) & (turn < STILL_TURN), least=least)


def lowest_points(pose: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Lowest mesh vertex in every frame of a pose track (T, 7), m, (T,)."""
    up = rotation(pose[:, 3:]).as_matrix()[:, 2]  # third row: R v, z component
    return (up @ vertices.T).min(axis=1) + pose[:, 2]


def estimate_support(
    poses: list[np.ndarray], vertices: list[np.ndarray], fps: float
) -> tuple[float, bool]:
    """Height of the main table from objects at rest, with mesh vertices.

    The lowest level that holds a still run at the start or the end of the motion;
    without one, the lowest still run; without any, the lowest vertex of all frames.

    Args:
        poses: per object (T, 7).
        vertices: per object (V, 3), m, object frame.
        fps: frames a second.

    Returns:
        Height, m, and whether anything was at rest there.
    """
    at_ends, inside = [], []
    lows = [lowest_points(p, v) for p, v in zip(poses, vertices, strict=True)]
    for pose, low in zip(poses, lows, strict=True):
        for start, end in still_runs(pose, fps):
            outer = start == 0 or end == len(pose)
            (at_ends if outer else inside).append(float(np.median(low[start:end])))
    heights = at_ends or inside
    if not heights:
        return float(min(low.min() for low in lows)), False
    lowest = min(heights)
    return float(np.median([h for h in heights if h < lowest + LEVEL_GAP / 5])), True


def support_disks(
    poses: list[np.ndarray], vertices: list[np.ndarray], fps: float
) -> np.ndarray:
    """Thin horizontal discs that carry the objects; the world's table is z = 0.

    The first is a large one at z = 0 under the whole motion; the others stand under
    objects that rest higher up, and not on another object.

    Returns:
        Discs [x, y, z_top, radius, height], m, (4, 5), NaN where unused.
    """
    disks = np.full((NUM_DISKS, 5), np.nan)
    track = np.concatenate([p[:, :2] for p in poses])
    centre = (track.min(0) + track.max(0)) / 2
    reach = np.linalg.norm(track - centre, axis=1).max() + TABLE_MARGIN
    disks[0] = [*centre, 0.0, reach, TABLE_HEIGHT]
    levels: list[np.ndarray] = []
    for slot, (pose, body) in enumerate(zip(poses, vertices, strict=True)):
        others = [p for i, p in enumerate(poses) if i != slot]
        levels += _raised_disks(pose, body, others, fps)
    for row, disk in enumerate(_merge(levels)[: NUM_DISKS - 1]):
        disks[row + 1] = disk
    return disks


def _raised_disks(
    pose: np.ndarray, vertices: np.ndarray, others: list[np.ndarray], fps: float
) -> list[np.ndarray]:
    found = []
    for start, end in still_runs(pose, fps):
        if start != 0 and end != len(pose):
            continue  # a still moment in mid motion is mostly a hand that waits
        points = rotation(pose[start, 3:]).apply(vertices) + pose[start, :3]
        top = points[:, 2].min()
        if top < LEVEL_GAP:
            continue  # the table carries it
        low, high = points[:, :2].min(0), points[:, :2].max(0)
        centre, reach = (low + high) / 2, (high - low).max() / 2
        beside = [np.linalg.norm(o[start, :2] - centre) > reach for o in others]
        below = [o[start, 2] < top - 0.10 for o in others]
        if all(a or b for a, b in zip(beside, below, strict=True)):
            radius = next((r for r in RADIUS_CLASSES if r >= reach), RADIUS_CLASSES[-1])
            found.append(np.array([*centre, top, radius, DISK_HEIGHT]))
    return found


def _merge(disks: list[np.ndarray]) -> list[np.ndarray]:
    kept: list[np.ndarray] = []
    for disk in sorted(disks, key=lambda d: -d[3]):
        same = [
            k
            for k in kept
            if abs(k[2] - disk[2]) < LEVEL_GAP
            and np.linalg.norm(k[:2] - disk[:2]) < k[3]
        ]
        if same:
            same[0][2] = min(same[0][2], disk[2])
        else:
            kept.append(disk)
    return kept
