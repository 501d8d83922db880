"""Convex parts of a mesh for collision, and its mass properties."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from flashdex.errors import MeshError
from flashdex.geometry.points import farthest_point_sampling
from flashdex.objects.bodies import bounds_volume, fault_of_mass
from flashdex.objects.decompose import run_coacd
from flashdex.objects.fit import measure_fit
from flashdex.objects.simplify import simplify
from flashdex.system.limited import LimitError

logger = logging.getLogger(__name__)

CONVEX_TOLERANCE = 0.01  # a mesh this close to its hull's volume is its own part
MIN_PART_VOLUME = 1e-5  # share of the hull; slivers below it only slow contacts down
# CoACD cuts as well on few triangles with a short search, 5 to 25 times as fast
QUICK_FACES = 600
QUICK_SECONDS = 60  # of CPU time
QUICK: dict[str, Any] = {
    **{"preprocess_mode": "off", "resolution": 500},
    **{"mcts_iterations": 15, "mcts_nodes": 10},
}
# it makes a closed mesh of what is not; 150 iterations take twice as long and cut alike
THOROUGH: dict[str, Any] = {"mcts_iterations": 60}
INERTIA_SLACK = 1e-6  # of the largest moment, added to all three


def compute_convex_parts(
    mesh: trimesh.Trimesh,
    *,
    max_parts: int,
    threshold: float,
    max_vertices: int,
    seed: int,
    name: str,
) -> list[NDArray[np.float32]]:
    """Cover a cleaned mesh with convex hulls by CoACD; ``name`` is for messages.

    A mesh whose volume is within 1 % of its hull's is its own single part; the other
    arguments are those of :class:`flashdex.objects.asset.ObjectSettings`. The quick
    way is taken where its parts lie near the surface, else the thorough one.

    Returns:
        Vertices of each hull in the object frame, m, float32, each (V, 3), largest
        volume first.
    """
    whole = mesh.convex_hull
    convex = bounds_volume(mesh) and mesh.volume > (1 - CONVEX_TOLERANCE) * whole.volume
    one = [_reduce_hull(np.asarray(whole.vertices), max_vertices).astype(np.float32)]
    if convex or max_parts <= 1:
        return one
    options = {"threshold": threshold, "max_convex_hull": max_parts, "seed": seed}

    def cut(mesh: trimesh.Trimesh, **way: Any) -> list[NDArray[np.float32]]:
        given = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        found = run_coacd(*given, **options, **way)
        if len(found) > max_parts:
            raise LimitError(f"more than {max_parts} parts")
        return _make_hulls(found, MIN_PART_VOLUME * whole.volume, max_vertices)

    limit = threshold * float(mesh.extents.max()) / 2  # what CoACD's is a share of
    try:
        small = simplify(mesh, max_faces=QUICK_FACES)
        parts = cut(small, seconds=QUICK_SECONDS, **QUICK)
        fit = measure_fit(mesh, parts, seed=seed)
        if fit.is_within(limit):
            return parts
        told = f"{fit}; allowed {1e3 * limit:.1f} mm"
    except (LimitError, MemoryError, ValueError, QhullError) as error:
        told = str(error)
    logger.info("%s: convex parts the slow way; the quick one: %s", name, told)
    try:
        return cut(mesh, **THOROUGH) or one
    except LimitError as error:
        logger.warning("%s: CoACD failed (%s); one convex hull instead", name, error)
        return one


def _make_hulls(
    parts: list[NDArray[np.float64]], least: float, max_vertices: int
) -> list[NDArray[np.float32]]:
    """Corners of each part's hull, largest volume first, without slivers, m^3."""
    hulls = []
    for vertices in parts:
        try:
            hull = ConvexHull(vertices)
        except QhullError:
            continue
        if hull.volume > least:
            hulls.append((hull.volume, vertices[hull.vertices]))
    hulls.sort(key=lambda item: -item[0])
    return [_reduce_hull(v, max_vertices).astype(np.float32) for _, v in hulls]


def _reduce_hull(
    vertices: NDArray[np.float64], max_vertices: int
) -> NDArray[np.float64]:
    if len(vertices) <= max_vertices:
        return vertices
    order = farthest_point_sampling(torch.from_numpy(vertices), max_vertices)
    kept = vertices[order.numpy()]
    # Fewer corners lie inside the hull; growing about the mean keeps its volume.
    growth = (ConvexHull(vertices).volume / ConvexHull(kept).volume) ** (1 / 3)
    centre = kept.mean(axis=0)
    return centre + growth * (kept - centre)


def compute_mass_properties(
    mesh: trimesh.Trimesh,
    parts: list[NDArray[np.float32]],
    *,
    density: float,
    mass_limits: tuple[float, float],
    name: str,
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Mass, centre of mass and inertia of a homogeneous solid.

    The solid is the mesh (cleaned, m) where it bounds a volume, else the sum of its
    convex parts (vertices, m, each (V, 3)). Density is kg/m^3, limits are kg. What no
    body can have is not taken from a mesh, whatever it bounds.
    ``inertia = mass / volume * (integral of |r|^2 1 - r r^T over the solid)``.

    Returns:
        Mass, kg; centre of mass in the object frame, m, (3,); inertia about the centre
        of mass in object axes, kg m^2, (3, 3), positive definite with every moment
        below the sum of the other two.

    Raises:
        MeshError: not even the parts have such; ``name`` is for it.
    """
    corners = np.asarray(mesh.convex_hull.vertices)
    if bounds_volume(mesh):
        found = _sum_of_solids([mesh], density, mass_limits)
        if not fault_of_mass(*found, corners):
            return found
    hulls = [trimesh.convex.convex_hull(part) for part in parts]
    found = _sum_of_solids(hulls, density, mass_limits)
    if fault := fault_of_mass(*found, corners):
        raise MeshError(f"{name}: {fault}. Are its triangles facing outward?")
    return found


def _sum_of_solids(
    solids: list[trimesh.Trimesh], density: float, mass_limits: tuple[float, float]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    volumes = np.array([s.volume for s in solids])
    centres = np.array([s.center_mass for s in solids])
    volume = float(volumes.sum())
    com = volumes @ centres / volume
    second = np.zeros((3, 3))
    for solid, part_volume, centre in zip(solids, volumes, centres, strict=True):
        arm = centre - com
        second += solid.moment_inertia / solid.density
        second += part_volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    mass = float(np.clip(density * volume, *mass_limits))
    inertia = mass / volume * 0.5 * (second + second.T)
    # The same amount on all three moments keeps a + b > c and lifts rounding errors.
    slack = INERTIA_SLACK * float(np.linalg.eigvalsh(inertia)[-1])
    return mass, com, inertia + slack * np.eye(3)
