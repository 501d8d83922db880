"""How well convex parts stand for the surface of a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from flashdex.objects.signed_distance import surface_distance, winding_number

Array = NDArray[np.float64]

NUM_SAMPLES = 1000  # points of either surface
STEP = 0.003  # m, between samples that distances are sought among
LEAST_BULGE = 2e-4  # m; nearer to the surface is neither inside nor outside


@dataclass(frozen=True)
class Fit:
    """Gaps between a surface and the union of convex parts, m, one a sample."""

    uncovered: Array  # of the surface from the union, 0 within it
    bulge: Array  # of the union's surface from the mesh, 0 inside of it

    def is_within(self, limit: float) -> bool:
        """Whether nothing is uncovered by more, m, nor nearly all filled by twice it.

        The parts of thin bowls, of which there may be so many only, fill more whichever
        way they are cut.
        """
        filled = float(np.percentile(self.bulge, 95)) if len(self.bulge) else 0.0
        return bool(self.uncovered.max(initial=0.0) <= limit and filled <= 2 * limit)

    def __str__(self) -> str:
        """Both gaps in words."""
        pairs = (("uncovered", self.uncovered), ("filled", self.bulge))
        told = [f"{1e3 * a.max(initial=0.0):.1f} mm {name}" for name, a in pairs]
        return "up to " + ", up to ".join(told)


def measure_fit(
    mesh: trimesh.Trimesh, parts: Sequence[NDArray[np.floating]], *, seed: int
) -> Fit:
    """Compare a mesh (m) with the hulls of parts, vertices each (V, 3), by samples.

    Raises:
        QhullError: a part is flat.
    """
    hulls = [ConvexHull(np.asarray(part, dtype=np.float64)) for part in parts]
    solids = [trimesh.Trimesh(h.points, h.simplices, process=False) for h in hulls]
    union = trimesh.util.concatenate(solids)
    assert isinstance(union, trimesh.Trimesh)
    points = _sample(mesh, seed)
    uncovered = np.zeros(len(points))
    outside = (_depth(points, hulls) > 0).all(axis=0)
    uncovered[outside] = surface_distance(union, points[outside], step=STEP)
    points = _sample(union, seed)
    points = points[(_depth(points, hulls) < -1e-6).sum(axis=0) == 0]
    bulge = surface_distance(mesh, points, step=STEP)
    far = bulge > LEAST_BULGE
    inside = winding_number(np.asarray(mesh.triangles), points[far]) > 0.5
    bulge[~far] = 0.0
    bulge[np.flatnonzero(far)[inside]] = 0.0
    return Fit(uncovered, bulge)


def _sample(mesh: trimesh.Trimesh, seed: int) -> Array:
    points, *_ = trimesh.sample.sample_surface(mesh, NUM_SAMPLES, seed=seed)
    return np.asarray(points, dtype=np.float64)


def _depth(points: Array, hulls: list[ConvexHull]) -> Array:
    """Signed distance of points to the planes of each hull, the largest, m, (K, N)."""
    planes = [hull.equations for hull in hulls]
    return np.stack([(points @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes])
