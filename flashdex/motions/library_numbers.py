"""Whether the numbers of a motion library are such that physics can use them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from flashdex.errors import LibraryError
from flashdex.motions.library_format import ARRAYS, FRAME_KEYS, OBJECT_KEYS, Manifest
from flashdex.motions.library_meshes import Mesh
from flashdex.motions.velocities import find_other_velocities
from flashdex.objects.bodies import MASS, MAX_SIZE
from flashdex.objects.signed_distance import triangle_distance, winding_number

Arrays = Mapping[str, np.ndarray]
ROWS = 16_384  # checked at a time: the check of a large array needs little memory
# Smallest and largest value of each array; generous, what is beyond is no motion.
# m and rad: 100; m/s: 50, rad/s: 200, as joints of both kinds have. NaN and infinity
# are in no range.
LIMITS = {
    **{name: (-100.0, 100.0) for name, (dtype, _) in ARRAYS.items() if "32" in dtype},
    **{f"frames/{k}": (-200.0, 200.0) for k in FRAME_KEYS if k.endswith("vel")},
    **{f"frames/{k}": (-50.0, 50.0) for k in FRAME_KEYS if k.endswith("linvel")},
    "frames/tip_dist": (0.0, 10.0),  # which stands for no object
    "objects/normals": (-1.001, 1.001),
    "objects/radius": (1e-5, 100.0),
    "objects/sdf_spacing": (1e-6, 10.0),
    "objects/mass": MASS,
}
del LIMITS["motions/support_disks"]
UNIT_SLACK = 1e-3  # of a norm from 1
BOX_SLACK = 0.1  # of a box's longest side, that a mesh and its parts may differ by
PARTS_SLACK = 0.2  # of the same, that a decomposition may leave out on one side
SURFACE_SLACK = 0.02  # of the same, by which a distance grid may miss the surface
NUM_NODES = 3  # of a distance grid, compared with the mesh; twice as many in its box
MAX_VERTICES = 10_000  # of a convex part; a hull of more takes for ever
MIN_THICKNESS = 1e-6  # m; the simulation knows no flat bodies
MIN_INERTIA = 1e-12  # kg m2; MuJoCo takes less than 1e-14 for none


def find_faults(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    """What is wrong with the numbers of a library; each line names array and row.

    Raises:
        LibraryError: its frames are not those of its motions.
    """
    yield from _motion_faults(manifest, arrays)
    names = manifest.names("motions")
    starts = arrays["motions/start"]
    has_fault = False
    for name, array in arrays.items():
        per_object = manifest.names("objects") if name.startswith("objects/") else None
        row = None
        if array.dtype == bool:
            row = _first(array.view(np.uint8), lambda v: _outside(v, 0, 1))
        if name in LIMITS:
            row = _first(array, lambda v, n=name: _outside(v, *LIMITS[n]))
        if row is None and name.endswith("_quat"):
            row = _first(array, _no_rotation)
        if row is not None:
            where = _where(row, per_object, names, starts)
            has_fault = has_fault or name.startswith("frames/")
            yield f"{name}: {_values(array[row])} {where}"
    if not has_fault:
        yield from _velocity_faults(manifest, arrays)
    for row, name in enumerate(manifest.names("objects")):
        for fault in _body_faults(
            {k: arrays[f"objects/{k}"][row] for k in OBJECT_KEYS}
        ):
            yield f"object {name!a}: {fault}"


def _velocity_faults(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    fps = float(manifest.entries["fps"])
    names, starts = manifest.names("motions"), arrays["motions/start"]
    found = find_other_velocities(arrays, fps, manifest.seed)
    for name, row, told, wanted in found:
        where = _where(row, None, names, starts)
        yield f"{name}: holds {told:.4g}, the positions say {wanted:.4g} {where}"


def _first(array: np.ndarray, is_bad: Any) -> int | None:
    """First row of an array with a bad value."""
    for start in range(0, len(array), ROWS):
        bad = is_bad(array[start : start + ROWS])
        if bad is not None and bad.any():
            return start + int(np.argmax(bad))
    return None


def _outside(values: np.ndarray, low: float, high: float) -> np.ndarray | None:
    # the smallest and the largest say it, NaN included, in one pass without copies
    if values.min() >= low and values.max() <= high:
        return None
    flat = values.reshape(len(values), -1)
    return np.asarray(~((flat >= low) & (flat <= high)).all(-1))


def _no_rotation(quat: np.ndarray) -> np.ndarray:
    norm = np.sqrt(np.square(quat, dtype=np.float64).sum(-1))
    return (np.abs(norm - 1) > UNIT_SLACK).reshape(len(quat), -1).any(-1)


def _values(row: np.ndarray) -> str:
    flat = np.asarray(row, np.float64).reshape(-1)
    odd = flat[~np.isfinite(flat)]
    if odd.size:
        return f"holds {odd[0]}"
    return f"holds {flat.min():.4g} ... {flat.max():.4g}, which cannot be"


def _where(row: int, objects: list[str] | None, names: list[str], starts: Any) -> str:
    if objects is not None:
        return f"at object {objects[row]!a}"
    motion = int(np.searchsorted(starts, row, side="right")) - 1
    return f"at frame {row - int(starts[motion])} of motion {names[motion]!a}"


def _motion_faults(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    """Rows of frames, objects and slots that motions name; raises where none do."""
    start, length = arrays["motions/start"], arrays["motions/length"]
    total = manifest.arrays["frames/joint_pos"].shape[0]
    index, slot = arrays["motions/object_index"], arrays["motions/hand_object"]
    ends = np.cumsum(length, dtype=np.float64)
    is_split = (length > 0).all() and ends[-1] == total
    if not is_split or (start != np.concatenate([[0], np.cumsum(length)[:-1]])).any():
        raise LibraryError(
            f"motions/start, motions/length: {int(ends[-1])} frames of {len(length)} "
            f"motions announced, {total} frames found, each of one motion."
        )
    if index.min() < -1 or index.max() >= manifest.arrays["objects/mass"].shape[0]:
        raise LibraryError("motions/object_index: names objects that are not there.")
    if slot.min() < -1 or slot.max() >= index.shape[1]:
        raise LibraryError("motions/hand_object: names slots that are not there.")
    held = np.take_along_axis(index, slot.clip(0), 1) < 0
    for row in np.flatnonzero((held & (slot >= 0)).any(1)):
        yield f"motions/hand_object: motion {row} holds an empty slot"
    if (index < 0).all():
        yield "motions/object_index: no motion has an object"
    for row in np.flatnonzero(~arrays["motions/hand_active"].any(1)):
        yield f"motions/hand_active: motion {row} has no hand"
    discs = arrays["motions/support_disks"]
    is_free = np.asarray(np.isnan(discs).all(-1))
    is_thick = (discs[..., 3:] >= MIN_THICKNESS).all(-1)
    is_disc = np.asarray((np.abs(discs) <= 100).all(-1) & is_thick)
    is_late = is_disc[:, 1:] & is_free[:, :-1]  # the used ones come first
    for row in np.flatnonzero((~(is_free | is_disc)).any(-1) | is_late.any(-1)):
        yield f"motions/support_disks: those of motion {row} are no discs"


def _body_faults(body: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Of one object: a body that is not, or that no density could have."""
    (low, high), com = body["aabb"].astype(np.float64), body["com"]
    size = high - low
    inertia, mass = body["inertia"].astype(np.float64), float(body["mass"])
    if not np.isfinite(inertia).all():
        return  # that it is not was told
    if not (size > 0).all() or size.max() > 2 * MAX_SIZE:
        yield f"its box is {' x '.join(f'{s:.3g}' for s in size)} m, which no object is"
    slack = BOX_SLACK * size.max() + 1e-3
    points = body["points"]
    if ((points < low - slack) | (points > high + slack)).any():
        yield "its surface points lie outside of its box"
    origin, nodes = body["sdf_origin"].astype(np.float64), np.array(body["sdf"].shape)
    far = origin + float(body["sdf_spacing"]) * (nodes - 1)
    if ((origin > low + slack) | (far < high - slack)).any():
        yield "its distance grid does not cover its box"
    radius = float(np.linalg.norm(points, axis=-1).max())
    told = float(body["radius"])
    if abs(radius - told) > 1e-3 * radius:
        yield f"its radius is {told:.4g} m, its points say {radius:.4g}"
    if ((com < low - slack) | (com > high + slack)).any():
        yield f"its centre of mass {com.tolist()} lies outside of its box"
    main = np.linalg.eigvalsh((inertia + inertia.T) / 2)
    scale = np.abs(inertia).max()
    if np.abs(inertia - inertia.T).max() > 1e-3 * scale or main[0] < MIN_INERTIA:
        yield "its inertia is not symmetric and positive"
    elif main[0] + main[1] < main[2] * (1 - 1e-3):
        yield "its inertia is that of no body: two of three moments are below the third"
    elif main.sum() > 2.2 * mass * float(size @ size):
        yield f"its inertia is larger than {mass:.4g} kg in its box can have"


def parts_fault(parts: list[np.ndarray], box: np.ndarray) -> str:
    """Why convex parts, m, (V, 3) each, are not those of an object with this box."""
    low = np.min([part.min(0) for part in parts], axis=0)
    high = np.max([part.max(0) for part in parts], axis=0)
    gap = float(np.maximum(low - box[0], box[1] - high).max())
    if gap > PARTS_SLACK * float((box[1] - box[0]).max()) + 0.002:
        return f"its convex parts end {gap:.3g} m before its box does"
    return ""


def part_fault(vertices: np.ndarray, box: np.ndarray) -> str:
    """Why a convex part of an object cannot be simulated; empty where it can.

    Args:
        vertices: of the part, m, (V, 3).
        box: lower and upper corner of the object, m, (2, 3).
    """
    if len(vertices) > MAX_VERTICES:
        return f"has {len(vertices)} vertices, {MAX_VERTICES} are allowed"
    slack = BOX_SLACK * (box[1] - box[0]).max() + 0.01
    if not ((vertices >= box[0] - slack) & (vertices <= box[1] + slack)).all():
        return "lies outside of the box of its object"
    centred = vertices.astype(np.float64) - vertices.mean(0)
    if np.abs(centred @ np.linalg.svd(centred, full_matrices=False)[2][2]).max() < (
        MIN_THICKNESS
    ):
        return "is flat"
    return ""


def grid_fault(body: Mapping[str, np.ndarray], mesh: Mesh, seed: int) -> str:
    """Why a distance grid is not that of a mesh; empty where it is.

    The surface points lie at distance zero, their normals lead outward, no two
    neighbours differ by more than their distance, and some nodes are compared with the
    mesh, of which others made the grid.

    Args:
        body: arrays of one object, by name.
        mesh: visual mesh of the object, m.
        seed: of the nodes; not to be known to whoever made the grid.
    """
    grid, spacing = body["sdf"], float(body["sdf_spacing"])
    low, high = body["aabb"].astype(np.float64)
    if not np.isfinite([low, high]).all() or (low >= high).any():
        return "its box is none"
    side = float((high - low).max())
    nodes, normals = (body["points"] - body["sdf_origin"]) / spacing, body["normals"]
    below, at, above = (
        map_coordinates(grid, (nodes + step * normals).T, order=1, mode="nearest")
        for step in (-1, 0, 1)
    )
    if np.abs(np.linalg.norm(normals, axis=-1) - 1).max() > UNIT_SLACK or (
        # of an open mesh both sides are the same
        (above - below).mean() < -spacing / 4
    ):
        return "its normals are not of length one, or point inward"
    off = np.abs(at).max()
    if not off <= spacing + SURFACE_SLACK * side:
        return f"its distance grid is {off:.4g} m at its surface"
    far = np.abs(grid)
    for axis in range(3):
        step = np.diff(far, axis=axis)
        if max(step.max(), -step.min()) > 1.5 * spacing:
            return "its distance grid leaps between neighbouring nodes"
    draw, origin = np.random.default_rng(seed), body["sdf_origin"].astype(np.float64)
    corners = ((corner - origin) / spacing for corner in (low, high))
    first, last = (corner.round().clip(0, len(grid) - 1) for corner in corners)
    anywhere = draw.integers(len(grid), size=(NUM_NODES, 3))
    in_box = draw.integers(first, last + 1, size=(2 * NUM_NODES, 3))
    index = np.concatenate([anywhere, in_box])
    told = grid[tuple(index.T)].astype(np.float64)
    places = index * spacing + origin
    vertices, faces = mesh
    triangles = vertices.astype(np.float64)[faces]
    distance = triangle_distance(triangles, places)
    winding = winding_number(triangles, places)
    signed = np.where(winding > 0.5, -distance, distance)
    # near the hole of an open mesh nobody knows which side it is
    is_sure = np.abs(winding - 0.5) > 0.25
    gaps = np.where(is_sure, np.abs(told - signed), np.abs(np.abs(told) - distance))
    worst = int(gaps.argmax())
    if not gaps[worst] <= spacing + BOX_SLACK * side:
        text = f"its distance grid holds {told[worst]:.4g} m where its mesh is "
        return f"{text}{signed[worst]:.4g} m away"
    return ""
