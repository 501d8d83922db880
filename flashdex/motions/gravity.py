"""Which way is up: objects at rest share a table, and nothing moves through it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.tracks import rotation
from flashdex.motions.align import UP_ROTATION
from flashdex.motions.checks import Finding
from flashdex.motions.support import still_runs

Up = Literal["z", "y", "-y"]

WRONG = 0.02  # m: an axis whose table is violated by more is doubtful
RIGHT = 0.01  # m: the table of the suggested axis is violated by less
RISE = 0.05  # m that something rises from the table, or the axis proves nothing
AXES = {
    f"{sign}{'xyz'[i]}": (1.0 if sign == "+" else -1.0) * np.eye(3)[i]
    for i in range(3)
    for sign in "+-"
}


def check_up(
    poses: list[np.ndarray], vertices: list[np.ndarray], fps: float, *, up: Up = "z"
) -> list[Finding]:
    """Warn where another axis than z makes a clearly better table.

    A table is violated by objects that pass below it and by levels that differ between
    objects at rest at the start and at the end. Another axis is suggested only if its
    table holds, and something rises from it: a track in one plane proves nothing.

    Args:
        poses: of each object in a world that is taken to be z up, (T, 7).
        vertices: of each mesh (those of its hull do), m, (V, 3).
        fps: frames a second.
        up: what the recording says is up; only to name axes in its own world.
    """
    rest = [_ends_at_rest(pose, fps) for pose in poses]
    if not any(rest):
        return []
    fault, _ = _table(poses, vertices, rest, AXES["+z"])
    if fault <= WRONG:
        return []
    tables = {name: _table(poses, vertices, rest, axis) for name, axis in AXES.items()}
    better = {n: f for n, (f, rise) in tables.items() if f < RIGHT and rise > RISE}
    if not better:
        return []
    name = min(better, key=better.__getitem__)
    back = Rotation.from_euler("x", UP_ROTATION[up]).inv().apply(AXES[name])
    own = next(n for n, axis in AXES.items() if np.allclose(axis, back, atol=1e-6))
    text = (
        f"objects at rest miss one level by {100 * fault:.0f} cm along {up}, and by "
        f"{100 * better[name]:.1f} cm along {own}: is up {own}?"
    )
    return [Finding("W_UP", "warn", text)]


def _ends_at_rest(pose: np.ndarray, fps: float) -> list[int]:
    """One frame of every still run at the start or the end."""
    spans = still_runs(pose, fps)
    return [(a + b) // 2 for a, b in spans if a == 0 or b == len(pose)]


def _table(
    poses: list[np.ndarray],
    vertices: list[np.ndarray],
    rest: list[list[int]],
    axis: np.ndarray,
) -> tuple[float, float]:
    """How much the table along an axis is violated, and the rise above it, m."""
    lows = [
        ((axis @ rotation(p[:, 3:]).as_matrix()) @ v.T).min(axis=1) + p[:, :3] @ axis
        for p, v in zip(poses, vertices, strict=True)
    ]
    levels = [low[i] for low, frames in zip(lows, rest, strict=True) for i in frames]
    below = min(levels) - min(float(low.min()) for low in lows)
    rise = max(float(low.max()) for low in lows) - min(levels)
    return max(below, max(levels) - min(levels)), rise
