"""Objects ready for simulation and reward: points, convex parts, distances, mass."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import zipfile
import zlib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from flashdex.geometry.sdf import SdfGrid
from flashdex.objects.convex import compute_convex_parts, compute_mass_properties
from flashdex.objects.meshes import (
    clean_mesh,
    join_meshes,
    load_mesh,
    reduce_mesh,
    sample_surface_points,
)
from flashdex.objects.signed_distance import make_distance_grid, surface_distance
from flashdex.system.files import open_atomic, waiting_lock

Values = dict[str, Any]  # field of ObjectAsset to its value

SCALARS = ("radius", "sdf_spacing", "mass", "watertight")
DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


def write_cache(file: Path, values: Values) -> None:
    """Store the fields of an object as npz; a failure is logged and not fatal.

    Args:
        file: where; its directory is made.
        values: arrays, numbers, and ``parts``, a list of (V, 3) arrays.
    """
    arrays: Values = {k: np.asarray(v) for k, v in values.items() if k != "parts"}
    arrays["part_vertices"] = np.concatenate(values["parts"])
    arrays["part_sizes"] = np.array([len(p) for p in values["parts"]])
    try:
        with open_atomic(file) as stream:
            np.savez_compressed(stream, **arrays)
    except OSError as error:
        logger.warning("%s: object not cached (%s)", file, error)


def read_cache(file: Path, *, required: set[str]) -> Values | None:
    """Read what :func:`write_cache` stored.

    Args:
        file: the npz file.
        required: fields that must be there.

    Returns:
        The fields, or None when the file is absent, damaged or of another layout.
    """
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as stored:
            values: Values = {k: stored[k] for k in stored.files}
        cuts = np.cumsum(values.pop("part_sizes"))[:-1]
        values["parts"] = np.split(values.pop("part_vertices"), cuts)
        for scalar in SCALARS:
            values[scalar] = values[scalar].item()
        if set(values) != required:
            raise KeyError(*sorted(required ^ set(values)))
    except DAMAGED as error:
        logger.warning("%s: unreadable (%s); computing the object again", file, error)
        return None
    return values


logger = logging.getLogger(__name__)

CACHE_VERSION = 1  # raise when the same mesh and settings give another asset
MAX_VISUAL_FACES = 5000
MAX_WORK_FACES = 32000  # more only cost time in CoACD and the winding number

Floats = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class ObjectSettings:
    """How a mesh becomes an :class:`ObjectAsset`.

    Attributes:
        density: kg/m^3, of the volume the mesh encloses.
        mass_limits: smallest and largest mass, kg.
        num_points: surface points.
        sdf_resolution: nodes of the distance grid along each axis.
        sdf_margin: room between the bounding box and the grid's border, m.
        max_parts: most convex parts.
        threshold: concavity that CoACD leaves in a part.
        max_vertices: most vertices of a convex part.
        seed: of the surface sample and of CoACD.
    """

    density: float = 800.0
    mass_limits: tuple[float, float] = (0.05, 0.5)
    num_points: int = 128
    sdf_resolution: int = 64
    sdf_margin: float = 0.05
    max_parts: int = 16
    threshold: float = 0.07
    max_vertices: int = 64
    seed: int = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectAsset:
    """One object, in its own frame; metres and kilograms.

    Attributes:
        name: of the file or as given.
        points: surface points in farthest-point order, m, (P, 3).
        normals: outward unit normals at the points, (P, 3).
        radius: largest distance of a point from the object-frame origin, m.
        parts: vertices of the convex parts, m, each (V, 3).
        sdf: signed distance at the grid's nodes, m, negative inside, (R, R, R).
        sdf_origin: node (0, 0, 0), m, (3,).
        sdf_spacing: node spacing, m.
        mass: kg.
        com: centre of mass, m, (3,).
        inertia: about the centre of mass in object axes, kg m^2, (3, 3).
        aabb: lower and upper corner, m, (2, 3).
        watertight: whether the cleaned mesh bounds a volume.
        sha256: of the mesh and the settings; the cache key.
        visual_vertices: for drawing, m, (W, 3).
        visual_faces: triangles of the visual vertices, int32, (F, 3).
    """

    name: str
    points: Floats
    normals: Floats
    radius: float
    parts: list[Floats]
    sdf: Floats
    sdf_origin: Floats
    sdf_spacing: float
    mass: float
    com: Floats
    inertia: Floats
    aabb: Floats
    watertight: bool
    sha256: str
    visual_vertices: Floats
    visual_faces: NDArray[np.int32]


_COMPUTED = {f.name for f in fields(ObjectAsset)} - {"name", "sha256"}


def make_object(
    mesh: trimesh.Trimesh | Path | str,
    *,
    settings: ObjectSettings | None = None,
    cache_dir: Path | None = None,
    name: str | None = None,
) -> ObjectAsset:
    """Turn a mesh into all that simulation and reward need of an object.

    The result is kept in ``cache_dir/objects`` under the hash of the mesh and the
    settings; the second call reads it.

    Args:
        mesh: a mesh, or a file that trimesh reads; object frame, m.
        settings: None for the defaults.
        cache_dir: None for ``$FLASHDEX_CACHE``, else ``~/.cache/flashdex``.
        name: None for the file's stem, or ``object`` for a mesh in memory.

    Raises:
        MeshError: the mesh is missing or cannot be simulated; says which and why.

    Example:
        >>> box = trimesh.creation.box(extents=(0.04, 0.05, 0.06))
        >>> asset = make_object(box, name="box")
        >>> len(asset.parts), asset.points.shape, round(asset.mass, 3)
        (1, (128, 3), 0.096)
    """
    settings = settings or ObjectSettings()
    where = name or "object"
    if not isinstance(mesh, trimesh.Trimesh):
        where, path = str(mesh), Path(mesh)
        name = name or path.stem
        mesh = load_mesh(path)
    key = _fingerprint(mesh, settings)
    file = (cache_dir or default_cache_dir()) / "objects" / f"{key}.npz"
    stamp = _stamp(file)
    values = read_cache(file, required=_COMPUTED)
    if values is None:
        with waiting_lock(file):  # two workers often meet the same object at once
            if _stamp(file) != stamp:
                values = read_cache(file, required=_COMPUTED)
            if values is None:
                values = _compute(mesh, settings, where)
                write_cache(file, values)
                _tell_open(where, is_watertight=values["watertight"])
    return ObjectAsset(name=name or "object", sha256=key, **values)


def read_object(sha256: str, *, name: str, cache_dir: Path) -> ObjectAsset | None:
    """An object that was made before, by its hash; None when it is not cached.

    Args:
        sha256: of mesh and settings, as ``ObjectAsset.sha256`` says.
        name: to give it.
        cache_dir: as for :func:`make_object`.
    """
    file = cache_dir / "objects" / f"{sha256}.npz"
    values = read_cache(file, required=_COMPUTED)
    if values is None:
        return None
    return ObjectAsset(name=name, sha256=sha256, **values)


def default_cache_dir() -> Path:
    """``$FLASHDEX_CACHE``, else ``~/.cache/flashdex``."""
    chosen = os.environ.get("FLASHDEX_CACHE")
    return Path(chosen) if chosen else Path.home() / ".cache" / "flashdex"


def _fingerprint(mesh: trimesh.Trimesh, settings: ObjectSettings) -> str:
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    text = json.dumps([CACHE_VERSION, asdict(settings)], sort_keys=True)
    digest.update(text.encode())
    return digest.hexdigest()


def _stamp(file: Path) -> int | None:
    """When a file was written; None where there is none."""
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return None


def _tell_open(where: str, *, is_watertight: bool) -> None:
    if not is_watertight:
        logger.warning(
            "%s: the mesh is not watertight; volume, mass and inertia come from its "
            "convex parts",
            where,
        )


def _compute(mesh: trimesh.Trimesh, settings: ObjectSettings, where: str) -> Values:
    mesh = clean_mesh(mesh, name=where)
    small = reduce_mesh(mesh, max_faces=MAX_WORK_FACES)
    points, normals = sample_surface_points(
        mesh, settings.num_points, seed=settings.seed
    )
    parts = compute_convex_parts(
        small,
        max_parts=settings.max_parts,
        threshold=settings.threshold,
        max_vertices=settings.max_vertices,
        seed=settings.seed,
        name=where,
    )
    mass, com, inertia = compute_mass_properties(
        mesh, parts, density=settings.density, mass_limits=settings.mass_limits
    )
    grid = make_distance_grid(
        small,
        resolution=settings.sdf_resolution,
        margin=settings.sdf_margin,
        watertight=mesh.is_volume,
    )
    visual = reduce_mesh(mesh, max_faces=MAX_VISUAL_FACES)
    return {
        "points": points,
        "normals": normals,
        "radius": float(np.linalg.norm(points, axis=-1).max()),
        "parts": parts,
        "sdf": grid.values,
        "sdf_origin": np.float32(grid.origin),
        "sdf_spacing": grid.spacing,
        "mass": mass,
        "com": np.float32(com),
        "inertia": np.float32(inertia),
        "aabb": np.float32(mesh.bounds),
        "watertight": bool(mesh.is_volume),
        "visual_vertices": np.float32(visual.vertices),
        "visual_faces": np.asarray(visual.faces, dtype=np.int32),
    }


# nodes farther from the mesh keep its distance: parts bulge by less, m
BULGE = 0.03
_known: dict[str, np.ndarray] = {}


def make_slot_grid(assets: list[ObjectAsset], *, solid: bool) -> SdfGrid:
    """Distance grids of a motion's objects in float64, row = slot.

    Args:
        assets: objects by slot.
        solid: of mesh and convex parts together, instead of the mesh alone.
    """
    values = [solid_values(a) if solid else a.sdf for a in assets]
    return SdfGrid(
        torch.tensor(np.stack(values)).double(),
        torch.tensor(np.stack([a.sdf_origin for a in assets])).double(),
        torch.tensor([float(a.sdf_spacing) for a in assets]).double(),
    )


def solid_values(asset: ObjectAsset) -> np.ndarray:
    """Signed distance to the union of a mesh and its convex parts at grid nodes.

    Convex parts fill handles and hollows. Outside of all of them the distance is exact;
    inside, it is the depth in the part one is deepest in, min_k max_i (n_i . p + d_i).

    Args:
        asset: the object.

    Returns:
        m, (R, R, R).
    """
    if asset.sha256 not in _known:
        _known[asset.sha256] = _compute_solid(asset)
    return _known[asset.sha256]


def _compute_solid(asset: ObjectAsset) -> np.ndarray:
    near = np.argwhere((asset.sdf > 0) & (asset.sdf < BULGE))
    nodes = near * float(asset.sdf_spacing) + np.asarray(asset.sdf_origin, np.float64)
    depth = np.full(len(nodes), np.inf)
    hulls = []
    for part in asset.parts:
        hull = ConvexHull(np.asarray(part, float))
        planes = nodes @ hull.equations[:, :3].T + hull.equations[:, 3]
        depth = np.minimum(depth, planes.max(axis=1))
        hulls.append(trimesh.Trimesh(hull.points, hull.simplices, process=False))
    mesh = join_meshes(hulls)
    outside = depth > 0
    step = float(asset.sdf_spacing)
    depth[outside] = surface_distance(mesh, nodes[outside], step=step)
    values = asset.sdf.copy()
    index = tuple(near.T)
    values[index] = np.minimum(values[index], depth)
    return values
