"""Which objects of a scene come into contact with each other."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import KDTree

from flashdex.datasets.tracks import missing_frames, rotation

CONTACT = 0.01  # m between surfaces
SPACING = 0.005  # m between the samples of a surface
SAMPLES = (300, 4000)
STEP_SECONDS = 0.1


class Surfaces:
    """Samples of the surfaces of a scene's objects, in their own frames.

    Args:
        meshes: of the objects, m.
    """

    def __init__(self, meshes: list[trimesh.Trimesh]) -> None:
        self._points = [_sample(mesh) for mesh in meshes]
        self._trees = [KDTree(points) for points in self._points]

    def reached(
        self,
        touched: list[int],
        others: list[int],
        poses: list[np.ndarray],
        fps: float,
    ) -> set[int]:
        """Those of ``others`` that a touched object comes within 1 cm of.

        Args:
            touched: objects that hands touch.
            others: objects that they do not.
            poses: of all objects, (T, 7), NaN where not tracked.
            fps: frames a second.
        """
        step = max(round(STEP_SECONDS * fps), 1)
        poses = [pose[::step] for pose in poses]
        return {b for b in others if any(self._meet(a, b, poses) for a in touched)}

    def _meet(self, a: int, b: int, poses: list[np.ndarray]) -> bool:
        known = ~missing_frames(poses[a], poses[b])
        points, tree = self._points[a], self._trees[b]
        low, high = tree.mins - CONTACT, tree.maxes + CONTACT
        for first, second in zip(poses[a][known], poses[b][known], strict=True):
            world = rotation(first[3:]).apply(points) + first[:3]
            local = rotation(second[3:]).inv().apply(world - second[:3])
            near = local[((local > low) & (local < high)).all(axis=1)]
            if not len(near):
                continue
            gaps, _ = tree.query(near, distance_upper_bound=CONTACT)
            if np.isfinite(gaps).any():
                return True
        return False


def _sample(mesh: trimesh.Trimesh) -> np.ndarray:
    count = int(np.clip(mesh.area / SPACING**2, *SAMPLES))
    points, *_ = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points)
