"""Object meshes: reading, refusing what cannot be simulated, cleaning, sampling."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import QhullError

from flashdex.errors import MeshError, is_of_machine
from flashdex.objects.bodies import make_winding_consistent, orient_bodies
from flashdex.objects.mesh_files import MESH_SUFFIXES, read_scene

MIN_EXTENT, MAX_EXTENT = 0.005, 1.5  # m; outside, the unit is almost surely wrong
MIN_PART_AREA = 0.01  # share of the area below which a loose component is dropped
SAMPLES_PER_POINT = 64  # density of the sample that farthest points are chosen from


def load_mesh(path: Path) -> trimesh.Trimesh:
    """Read a file of ``MESH_SUFFIXES`` as one mesh, not cleaned; its unit is the metre.

    Scenes become one mesh, each geometry moved by the transform of its node.

    Raises:
        MeshError: the file is missing or is not such a mesh.
        OSError, MemoryError: the machine fails, see ``is_of_machine``.
    """
    if not path.is_file():
        raise MeshError(f"{path}: mesh file not found. Check the path in the source.")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError(
            f"{path}: not readable as a mesh. Allowed: {', '.join(MESH_SUFFIXES)}."
        )
    try:
        mesh = read_scene(path).to_mesh()
        if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,):
            raise ValueError("not triangles of points in space")
        if len(mesh.faces) and not _joins_vertices(mesh):
            raise ValueError("triangles of vertices that are not there")
    except Exception as error:  # each reader of trimesh fails in its own way
        if is_of_machine(error):
            raise
        text = f"{path}: not readable as a mesh ({error}). Allowed: "
        raise MeshError(f"{text}{', '.join(MESH_SUFFIXES)}.") from error
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _joins_vertices(mesh: trimesh.Trimesh) -> bool:
    return mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


def clean_mesh(mesh: trimesh.Trimesh, *, name: str) -> trimesh.Trimesh:
    """A mesh (m) with what can be repaired without changing its shape; a new one.

    Merges vertices, drops faces without area and loose components below 1 % of the
    area, makes the winding consistent, bodies outward and cavities inward, closes small
    holes; others stay.
    The name, of a file or object, is for messages.

    Raises:
        MeshError: nothing to simulate: empty, too few vertices, not finite, flat, or
            of a size that points to another unit.
    """
    _refuse_unusable(mesh, name)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    _drop_loose_components(mesh)
    mesh.remove_unreferenced_vertices()
    _refuse_flat(mesh, name)
    make_winding_consistent(mesh)
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)
        mesh.update_faces(mesh.unique_faces())  # a triangle is not closed by its back
    orient_bodies(mesh)
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def hull_vertices(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Vertices of the convex hull, m, (V, 3): all that can touch a table."""
    return np.asarray(mesh.convex_hull.vertices, dtype=np.float64)


def _refuse_unusable(mesh: trimesh.Trimesh, name: str) -> None:
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise MeshError(f"{name}: the mesh is empty (no triangles). Export it again.")
    if not _joins_vertices(mesh):
        raise MeshError(f"{name}: triangles of vertices that are not there.")
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=-1).sum())
        raise MeshError(f"{name}: {bad} vertices are not finite (NaN or infinite).")
    distinct = len(np.unique(mesh.vertices, axis=0))
    if distinct < 4:
        raise MeshError(f"{name}: {distinct} distinct vertices; a solid needs 4.")
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        hint = "Are they of another unit?"
        if extent > MAX_EXTENT:
            hint = "Are they centimetres (scale by 0.01) or millimetres (0.001)?"
        raise MeshError(
            f"{name}: the mesh is {extent:.4g} m long; allowed are {MIN_EXTENT} m to "
            f"{MAX_EXTENT} m. Vertices must be metres. {hint}"
        )


def _refuse_flat(mesh: trimesh.Trimesh, name: str) -> None:
    try:
        with np.errstate(all="ignore"):  # a flat hull divides by its volume
            volume = float(mesh.convex_hull.volume) if len(mesh.faces) else 0.0
    except QhullError:
        volume = 0.0
    # Below this share of the cube around it, it is a sheet and not a thin solid.
    if volume < 1e-6 * float(mesh.extents.max() if len(mesh.faces) else 1.0) ** 3:
        raise MeshError(
            f"{name}: the convex hull has no volume; the mesh is flat. "
            "Give it a thickness."
        )


def _drop_loose_components(mesh: trimesh.Trimesh) -> None:
    labels = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    )
    area = np.bincount(labels, weights=mesh.area_faces)
    large = area >= MIN_PART_AREA * area.sum()
    # A triangle soup consists of small components only: then they are the shape.
    if area[large].sum() > 0.9 * area.sum():
        mesh.update_faces(large[labels])


def reduce_mesh(mesh: trimesh.Trimesh, *, max_faces: int) -> trimesh.Trimesh:
    """Fewer faces: vertices that share a cell become their mean.

    A mesh within the limit is returned as it is.
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    low, high = np.array([1 / 512, 1 / 4]) * float(mesh.extents.max())
    best = _cluster(mesh, high)
    for _ in range(10):
        cell = np.sqrt(low * high)
        trial = _cluster(mesh, cell)
        if len(trial.faces) <= max_faces:
            high, best = cell, trial
        else:
            low = cell
    return best


def _cluster(mesh: trimesh.Trimesh, cell: float) -> trimesh.Trimesh:
    key = np.floor((mesh.vertices - mesh.bounds[0]) / cell).astype(np.int64)
    _, group = np.unique(key, axis=0, return_inverse=True)
    group = group.ravel()
    sums = np.stack([np.bincount(group, weights=x) for x in mesh.vertices.T], -1)
    mean = sums / np.bincount(group)[:, None]
    merged = trimesh.Trimesh(mean, group[mesh.faces], process=False)
    merged.update_faces(merged.nondegenerate_faces() & merged.unique_faces())
    merged.remove_unreferenced_vertices()
    return merged


def join_meshes(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh with the triangles of all parts; nothing is merged or cut."""
    mesh = trimesh.util.concatenate(list(parts))
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def sample_surface_points(
    mesh: trimesh.Trimesh, count: int, *, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Evenly spread surface points in farthest-point order, with outward normals.

    Returns:
        Points, m, object frame, (P, 3), and unit normals of their triangles, (P, 3).
    """
    import torch  # here: meshes are read, and sources listed, without it

    from flashdex.geometry.points import farthest_point_sampling

    number = SAMPLES_PER_POINT * count
    dense, face, *_ = trimesh.sample.sample_surface(mesh, number, seed=seed)
    dense = np.asarray(dense)
    order = farthest_point_sampling(torch.from_numpy(dense), count).numpy()
    normals = mesh.face_normals[face[order]]
    return dense[order].astype(np.float32), normals.astype(np.float32)
