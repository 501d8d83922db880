"""Support surfaces of a motion: thin discs under objects at rest."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.support import LEVEL_GAP, still_runs
from flashdex.datasets.tracks import rotation

NUM_DISKS = 4
RADIUS_CLASSES = (0.08, 0.15, 0.25, 0.40)
DISK_HEIGHT = 0.01
TABLE_HEIGHT = 0.02
TABLE_MARGIN = 0.40


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
