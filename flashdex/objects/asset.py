"""Objects ready for simulation and reward: points, convex parts, distances, mass."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from flashdex.errors import FlashdexError
from flashdex.objects.bodies import bounds_volume, fault_of_mass
from flashdex.objects.convex import compute_convex_parts, compute_mass_properties
from flashdex.objects.meshes import (
    clean_mesh,
    load_mesh,
    reduce_mesh,
    sample_surface_points,
)
from flashdex.objects.signed_distance import make_distance_grid
from flashdex.system.archives import read_npz
from flashdex.system.files import open_atomic, waiting_lock

logger = logging.getLogger(__name__)

CACHE_VERSION = 3  # raise when the same mesh and settings give another asset
MAX_VISUAL_FACES = 5000
MAX_WORK_FACES = 32000  # more only cost time in CoACD and the winding number
# what a torn, damaged or foreign file in the cache raises
DAMAGED = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError),
    RecursionError,
)
MAX_CACHED = 256 << 20  # bytes of an unpacked file of the cache

Floats = NDArray[np.float32]
Values = dict[str, Any]  # computed field of ObjectAsset to its value


@dataclass(frozen=True, kw_only=True)
class ObjectSettings:
    """How a mesh becomes an :class:`ObjectAsset`."""

    density: float = 800.0  # kg/m^3, of the volume the mesh encloses
    mass_limits: tuple[float, float] = (0.05, 0.5)  # kg
    num_points: int = 128  # on the surface
    sdf_resolution: int = 64  # nodes of the distance grid along each axis
    sdf_margin: float = 0.05  # m, between the bounding box and the grid's border
    max_parts: int = 16  # convex parts
    threshold: float = 0.07  # concavity that CoACD leaves in a part
    max_vertices: int = 64  # of a convex part
    seed: int = 1  # of the surface sample and of CoACD


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectAsset:
    """One object, in its own frame; metres and kilograms."""

    name: str  # of the file or as given
    points: Floats  # of the surface, in farthest-point order, m, (P, 3)
    normals: Floats  # outward unit normals at the points, (P, 3)
    radius: float  # largest distance of a point from the object-frame origin, m
    parts: list[Floats]  # vertices of the convex parts, m, each (V, 3)
    sdf: Floats  # signed distance at the grid's nodes, m, negative inside, (R, R, R)
    sdf_origin: Floats  # node (0, 0, 0), m, (3,)
    sdf_spacing: float  # between nodes, m
    mass: float  # kg
    com: Floats  # centre of mass, m, (3,)
    inertia: Floats  # about the centre of mass in object axes, kg m^2, (3, 3)
    aabb: Floats  # lower and upper corner, m, (2, 3)
    watertight: bool  # whether the cleaned mesh bounds a volume
    sha256: str  # of the mesh and the settings; the cache key
    visual_vertices: Floats  # for drawing, m, (W, 3)
    visual_faces: NDArray[np.int32]  # triangles of the visual vertices, (F, 3)


_SCALARS = ("radius", "sdf_spacing", "mass", "watertight")
_MASS = ("mass", "com", "inertia", "aabb")
# arrays of a file of the cache and their shapes; 0 for any length
_STORED: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(_SCALARS, ()),
    **dict.fromkeys(("com", "sdf_origin"), (3,)),
    **dict.fromkeys(("points", "normals", "part_vertices"), (0, 3)),
    **dict.fromkeys(("visual_vertices", "visual_faces"), (0, 3)),
    **{"inertia": (3, 3), "aabb": (2, 3), "sdf": (0, 0, 0), "part_sizes": (0,)},
}


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
        cache_dir: None for :func:`default_cache_dir`.
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
    file = _cache_file(key, cache_dir)
    stamp = _stamp(file)
    values = _read_cache(file)
    if values is None:
        with waiting_lock(file):  # two workers often meet the same object at once
            if _stamp(file) != stamp:
                values = _read_cache(file)
            if values is None:
                values = _compute(mesh, settings, where)
                _write_cache(file, values)
    return ObjectAsset(name=name or "object", sha256=key, **values)


def read_object(
    sha256: str, *, name: str, cache_dir: Path | None = None
) -> ObjectAsset | None:
    """An object that was made before, by its hash; None when it is not cached."""
    values = _read_cache(_cache_file(sha256, cache_dir))
    return None if values is None else ObjectAsset(name=name, sha256=sha256, **values)


def default_cache_dir() -> Path:
    """``$FLASHDEX_CACHE``, else ``~/.cache/flashdex``.

    Raises:
        FlashdexError: there is no home either.
    """
    chosen = os.environ.get("FLASHDEX_CACHE")
    try:
        return Path(chosen) if chosen else Path.home() / ".cache" / "flashdex"
    except RuntimeError as error:
        text = "no home directory to keep prepared objects in; set FLASHDEX_CACHE to "
        raise FlashdexError(f"{text}a folder.") from error


def _cache_file(key: str, cache_dir: Path | None) -> Path:
    return (cache_dir or default_cache_dir()) / "objects" / f"{key}.npz"


def _stamp(file: Path) -> int | None:
    """When a file was written; None where there is none."""
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return None


def _fingerprint(mesh: trimesh.Trimesh, settings: ObjectSettings) -> str:
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    text = json.dumps([CACHE_VERSION, asdict(settings)], sort_keys=True)
    digest.update(text.encode())
    return digest.hexdigest()


def _compute(mesh: trimesh.Trimesh, settings: ObjectSettings, where: str) -> Values:
    mesh = clean_mesh(mesh, name=where)
    watertight = bounds_volume(mesh)
    small = reduce_mesh(mesh, max_faces=MAX_WORK_FACES)
    visual = reduce_mesh(mesh, max_faces=MAX_VISUAL_FACES)
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
        mesh,
        parts,
        density=settings.density,
        mass_limits=settings.mass_limits,
        name=where,
    )
    sdf, origin, spacing = make_distance_grid(
        small,
        resolution=settings.sdf_resolution,
        margin=settings.sdf_margin,
        watertight=watertight,
    )
    if not watertight:
        logger.warning(
            "%s: the mesh is not watertight; volume, mass and inertia come from its "
            "convex parts",
            where,
        )
    return {
        "points": points,
        "normals": normals,
        "radius": float(np.linalg.norm(points, axis=-1).max()),
        "parts": parts,
        "sdf": sdf,
        "sdf_origin": np.float32(origin),
        "sdf_spacing": spacing,
        "mass": mass,
        "com": np.float32(com),
        "inertia": np.float32(inertia),
        "aabb": np.float32(mesh.bounds),
        "watertight": watertight,
        "visual_vertices": np.float32(visual.vertices),
        "visual_faces": np.asarray(visual.faces, dtype=np.int32),
    }


def _check_stored(stored: Values) -> None:
    """Refuse arrays of the cache that no object has: what wrote them was not we.

    Raises:
        ValueError: other fields, shapes or values.
    """
    if set(stored) != set(_STORED):
        raise ValueError(f"fields {sorted(set(_STORED) ^ set(stored))}")
    for name, shape in _STORED.items():
        array = stored[name]
        fits = array.ndim == len(shape) and array.dtype.kind in "biuf"
        wanted = np.array([n or m for n, m in zip(shape, array.shape, strict=False)])
        if not fits or (wanted != array.shape).any() or not np.isfinite(array).all():
            raise ValueError(f"{name}: {array.dtype} {array.shape}, or not finite")
    sizes = stored["part_sizes"]
    if sizes.min(initial=0) < 0 or sizes.sum() != len(stored["part_vertices"]):
        raise ValueError("convex parts of other sizes")
    faces = stored["visual_faces"]
    if faces.min(initial=0) < 0 or faces.max() >= len(stored["visual_vertices"]):
        raise ValueError("triangles of vertices that are not there")
    if fault := fault_of_mass(*(stored[key] for key in _MASS)):
        raise ValueError(fault)


def _write_cache(file: Path, values: Values) -> None:
    """Store the fields of an object as npz; a failure is logged and not fatal."""
    arrays: Values = {k: np.asarray(v) for k, v in values.items() if k != "parts"}
    arrays["part_vertices"] = np.concatenate(values["parts"])
    arrays["part_sizes"] = np.array([len(p) for p in values["parts"]])
    try:
        with open_atomic(file) as stream:
            np.savez_compressed(stream, **arrays)
    except OSError as error:
        logger.warning("%s: object not cached (%s)", file, error)


def _read_cache(file: Path) -> Values | None:
    """The stored fields; None when the file is absent, damaged or of another layout."""
    if not file.is_file():
        return None
    try:
        values: Values = dict(read_npz(file, limit=MAX_CACHED))
        _check_stored(values)
        cuts = np.cumsum(values.pop("part_sizes"))[:-1]
        values["parts"] = np.split(values.pop("part_vertices"), cuts)
        for scalar in _SCALARS:
            values[scalar] = values[scalar].item()
    except DAMAGED as error:
        logger.warning("%s: unreadable (%s); computing the object again", file, error)
        return None
    return values
