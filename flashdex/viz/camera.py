"""Where to put a camera that shows a whole rollout: plain geometry, no graphics."""

from __future__ import annotations

import math

import numpy as np

from flashdex.rollouts.rollout import Rollout

MARGIN = 0.08  # m, kept free around every point: hands and objects have a size
MIN_DISTANCE = 0.35  # m
CENTRING_STEPS = 8


def moving_points(rollout: Rollout) -> np.ndarray:
    """World positions that the camera has to show, m, (n, 3).

    Args:
        rollout: stored rollout.
    """
    hands = np.flatnonzero(rollout.hand_active)
    slots = np.flatnonzero(np.asarray(rollout.object_qpos_adr) >= 0)
    tracks = [rollout.fingertips[:, hands], rollout.joints[:, hands]]
    tracks += [rollout.object_pos[:, slots], rollout.ref_object_pos[:, slots]]
    points = np.concatenate([track.reshape(-1, 3) for track in tracks])
    return points[np.isfinite(points).all(1)]


def view_axes(
    azimuth: float, elevation: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions forward, right and up of MuJoCo's free camera in the world, each (3,).

    Args:
        azimuth: deg.
        elevation: deg, negative looks down.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    level = np.array([math.cos(a), math.sin(a), 0.0])
    forward = math.cos(e) * level + np.array([0.0, 0.0, math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return forward, right, np.cross(right, forward)


def fit_view(
    points: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    fovy: float,
    aspect: float,
) -> tuple[np.ndarray, float]:
    """Where to look and from how far, so that the points fill the picture.

    A point (x, y, z) on the axes (right, up, forward) from the point looked at is
    inside if ``|y| + margin <= (d + z) tan(fovy / 2)``, and likewise ``|x|`` with the
    aspect. The smallest such d is taken, then the view is moved until the picture has
    equal room on opposite sides; perspective makes this a fixed-point iteration.

    Args:
        points: world, m, (n, 3).
        axes: forward, right, up, from :func:`view_axes`.
        fovy: vertical opening angle, deg.
        aspect: width over height.

    Returns:
        Point looked at, m, (3,), and distance from it, m.
    """
    forward, right, up = axes
    lookat = (points.min(0) + points.max(0)) / 2
    for _ in range(CENTRING_STEPS):
        distance = _fit_distance(points - lookat, axes, fovy=fovy, aspect=aspect)
        depth = distance + (points - lookat) @ forward
        for axis in (right, up):
            seen = (points - lookat) @ axis / depth
            lookat = lookat + axis * (seen.min() + seen.max()) * distance / 2
    return lookat, _fit_distance(points - lookat, axes, fovy=fovy, aspect=aspect)


def _fit_distance(
    points: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    fovy: float,
    aspect: float,
) -> float:
    forward, right, up = axes
    half = math.tan(math.radians(fovy) / 2)
    wide = (np.abs(points @ right) + MARGIN) / (half * aspect) - points @ forward
    high = (np.abs(points @ up) + MARGIN) / half - points @ forward
    return max(MIN_DISTANCE, float(np.max([wide, high])))
