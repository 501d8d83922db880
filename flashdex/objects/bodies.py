"""Closed bodies of a mesh: which bound the solid, which a cavity, and which way round.

A file may hold a body inside out, or bodies inside of bodies. Volume, centre of mass
and inertia are sums of signed tetrahedra: one body of the wrong sense takes away what
it should add, and the centre of mass ends up anywhere.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from flashdex.objects.signed_distance import winding_number

# What a hand moves: kg, from a gram up; kg/m3 of its convex parts, foam to tungsten;
# and m, the largest distance from its middle.
MASS = (1e-3, 20.0)
DENSITY = (5.0, 25_000.0)
MAX_SIZE = 3.0
MAX_NESTED = 100  # bodies between which nesting is sought; more stand side by side
LEAST_FILL = 1e-3  # share of its hull that a solid has
NUM_SAMPLES = 16  # vertices of a body that must all be inside of another


def make_winding_consistent(mesh: trimesh.Trimesh) -> None:
    """Turn triangles, in place, so that neighbours agree; the larger part is right.

    Only within what is connected by edges: the sense of each body is left to
    ``orient_bodies``.
    """
    if mesh.is_winding_consistent:
        return
    before = mesh.faces.copy()
    trimesh.repair.fix_winding(mesh)
    label = _labels(mesh)
    turned = (mesh.faces != before).any(axis=1)
    area = mesh.area_faces
    share = np.bincount(label, weights=area * turned) / np.bincount(label, weights=area)
    _turn(mesh, (share > 0.5)[label])


def orient_bodies(mesh: trimesh.Trimesh) -> None:
    """Turn closed bodies outward and cavities inward, in place; drop what fills none.

    A body that lies inside of another is a cavity where the file has it the other way
    round than the body around it; otherwise it is in the solid already, and goes. What
    is not closed stays as it is.
    """
    label = _labels(mesh)
    closed = _closed(mesh, label)
    volume = np.bincount(label, weights=_tetrahedra(mesh))
    # bodies by size, so that what is around one comes before it
    order = np.flatnonzero(closed)[np.argsort(-np.abs(volume[closed]), kind="stable")]
    wanted = np.zeros(len(closed))  # sense of each body; 0 for what is dropped
    around: list[int] = []
    is_sought = len(order) <= MAX_NESTED  # each pair costs a look at all triangles
    for body in order:
        inside = [b for b in around if is_sought and _holds(mesh, label, b, body)]
        parent = inside[-1] if inside else None
        if parent is None:
            wanted[body] = 1.0
        elif np.sign(volume[body]) != np.sign(volume[parent]):
            wanted[body] = -wanted[parent]
        else:
            continue
        around.append(int(body))
    _turn(mesh, (closed & (wanted * volume < 0))[label])
    mesh.update_faces(~(closed & (wanted == 0))[label])


def bounds_volume(mesh: trimesh.Trimesh) -> bool:
    """Whether a cleaned mesh bounds a solid: closed, and more than sheets and slivers.

    Loose triangles that hole filling closed with their own backs bound nothing.
    """
    return bool(mesh.is_volume and mesh.volume > LEAST_FILL * mesh.convex_hull.volume)


def _labels(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """Body of each triangle, by common edges, (F,)."""
    return trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    ).astype(np.int64)


def _closed(mesh: trimesh.Trimesh, label: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each edge of a body has two of its triangles, by body."""
    edges = np.column_stack([np.repeat(label, 3), mesh.edges_sorted])
    rows, counts = np.unique(edges, axis=0, return_counts=True)
    closed = np.ones(label.max(initial=-1) + 1, dtype=bool)
    closed[rows[counts != 2, 0]] = False
    return closed


def _tetrahedra(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Signed volume that each triangle spans with the centre, m^3, (F,)."""
    corners = np.asarray(mesh.triangles, dtype=np.float64) - mesh.bounds.mean(axis=0)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6


def _holds(
    mesh: trimesh.Trimesh, label: NDArray[np.int64], outer: int, inner: int
) -> bool:
    """Whether one body lies inside of another as a whole."""
    shell = np.asarray(mesh.triangles[label == outer], dtype=np.float64)
    part = np.asarray(mesh.triangles[label == inner], dtype=np.float64).reshape(-1, 3)
    low, high = shell.min(axis=(0, 1)), shell.max(axis=(0, 1))
    if (part < low).any() or (part > high).any():
        return False
    points = part[:: max(1, len(part) // NUM_SAMPLES)]
    return bool((np.abs(winding_number(shell, points)) > 0.5).all())


def _turn(mesh: trimesh.Trimesh, chosen: NDArray[np.bool_]) -> None:
    if chosen.any():
        faces = mesh.faces.copy()
        faces[chosen] = faces[chosen][:, ::-1]
        mesh.faces = faces


def fault_of_mass(
    mass: float,
    com: NDArray[np.floating],
    inertia: NDArray[np.floating],
    corners: NDArray[np.floating],
) -> str:
    """What is impossible about the mass of a body; empty where nothing is.

    Args:
        mass: kg.
        com: centre of mass, m, (3,).
        inertia: about it, kg m^2, (3, 3).
        corners: of the body's hull, or the lower and upper one of its box, m, (V, 3).
    """
    numbers = [np.ravel(mass), np.ravel(com), np.ravel(inertia), np.ravel(corners)]
    if not np.isfinite(np.concatenate(numbers)).all():
        return "its mass properties are not finite"
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.linalg.norm(high - low)
    if not mass > 0:
        return f"its mass is {mass:.3g} kg"
    outside = np.maximum(low - com, com - high).max()
    if len(corners) > 2:
        faces = ConvexHull(corners).equations
        outside = (faces[:, :3] @ com + faces[:, 3]).max()
    if outside > 1e-3 * size:
        return "its centre of mass lies outside of it"
    moments = np.linalg.eigvalsh(np.asarray(inertia, dtype=np.float64))
    if not moments[0] > 0 or moments[2] > (1 + 1e-3) * (moments[0] + moments[1]):
        return f"its moments of inertia {moments} belong to no body"
    if moments[2] > mass * size**2:
        return f"its moments of inertia {moments} are too large for its size"
    return ""
