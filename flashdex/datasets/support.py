"""Where objects rest, read off their tracks: table height of a recording."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import UP_ROTATION, HumanDemo
from flashdex.datasets.tracks import (
    angular_velocity,
    linear_velocity,
    missing_frames,
    rotation,
    runs,
    transform_pose,
)
from flashdex.objects.meshes import clean_mesh, hull_vertices

STILL_SPEED = 0.03  # m/s
STILL_TURN = 0.3  # rad/s
STILL_SECONDS = 1 / 6
LONGEST_SMOOTHING = 0.15  # s
LEVEL_GAP = 0.05  # m; heights closer than this are one level


def still_runs(pose: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Runs of frames (start, end excluded) in which a pose track (T, 7) rests.

    Still = slower than 0.03 m/s and 0.3 rad/s for at least 1/6 s.
    """
    speed, turn = speeds(pose, fps)
    least = max(int(np.ceil(STILL_SECONDS * fps)), 2)
    return runs((speed < STILL_SPEED) & (turn < STILL_TURN), least=least)


def speeds(pose: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Speed, m/s, and rate of turn, rad/s, of a pose track (T, 7), (T,) each.

    Smoothed as long as its own noise asks for, in seconds: differences of frames hold
    the more noise the more frames there are, and an object at rest must rest at any
    rate. A track without noise is smoothed over one frame.
    """
    place = np.diff(pose[:, :3], axis=0)
    steps = (rotation(pose[1:, 3:]) * rotation(pose[:-1, 3:]).inv()).as_rotvec()
    sigma = _smoothing(place, STILL_SPEED, fps)
    speed = np.linalg.norm(linear_velocity(pose[:, :3], fps, sigma=sigma), axis=-1)
    sigma = _smoothing(steps, STILL_TURN, fps)
    turn = np.linalg.norm(angular_velocity(pose[:, 3:], fps, sigma=sigma), axis=-1)
    return speed, turn


def _smoothing(steps: np.ndarray, limit: float, fps: float) -> float:
    """Frames of a Gaussian that brings the noise of a velocity well below a limit.

    White noise s in a track is ``s / sqrt(4 sqrt(pi) fps tau^3)`` in its derivative
    smoothed over tau. Fourth differences of it, third ones of its steps (T - 1, 3),
    are sqrt(70) s, and hold next to nothing of a motion; a quarter of the frames, of
    which normal noise has 0.32 s, is enough to tell.
    """
    fourth = np.abs(np.diff(steps, n=3, axis=0))
    if not len(fourth):
        return 1.0
    noise = float(np.quantile(fourth, 0.25)) / 0.3186 / np.sqrt(70)
    wanted = (limit / 6) ** 2 * 4 * np.sqrt(np.pi) * fps
    seconds = (noise**2 / wanted) ** (1 / 3)
    return max(1.0, fps * min(seconds, LONGEST_SMOOTHING))


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

    Of pose tracks (T, 7) and vertices (V, 3), m, object frame, per object: the height,
    m, and whether anything was at rest there.
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


def demo_support(
    demo: HumanDemo, meshes: list[trimesh.Trimesh] | None = None
) -> float | None:
    """Height, m, along its up axis, of the table that a recording's objects rest on.

    None if none rests. The objects' ``meshes``, cleaned, m, are read by default; a
    ``MeshError`` if one cannot be used.
    """
    if meshes is None:
        meshes = [clean_mesh(b.load_mesh(), name=b.name) for b in demo.objects]
    turn = Rotation.from_euler("x", UP_ROTATION[demo.up])
    poses, vertices = [], []
    for body, mesh in zip(demo.objects, meshes, strict=True):
        hull = hull_vertices(mesh)
        for start, end in runs(~missing_frames(body.pose), least=3):
            poses.append(transform_pose(body.pose[start:end], turn))
            vertices.append(hull)
    if not poses:
        return None
    height, found = estimate_support(poses, vertices, demo.fps)
    return height if found else None
