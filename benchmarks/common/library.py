"""Motion libraries for measuring: chosen numbers of objects and of convex parts."""

from __future__ import annotations

import heapq
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from flashdex.datasets.source import SourceOptions
from flashdex.errors import FlashdexError, LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import LibraryWriter, MotionRecord
from flashdex.motions.pipeline.prepare import Order, run_order
from flashdex.objects.asset import ObjectAsset, default_cache_dir

Vertices = NDArray[np.float64]


def cut_hull(vertices: NDArray[np.floating], count: int) -> list[Vertices]:
    """Cut a convex body into parts that touch and do not overlap.

    The largest part is cut across its longest side until there are enough: vertices of
    each part, m, (V, 3), largest volume first.
    """
    tie = itertools.count()  # arrays cannot be compared
    first = _corners(np.asarray(vertices, np.float64))
    parts = [(-ConvexHull(first).volume, next(tie), first)]
    while len(parts) < count:
        _, _, largest = heapq.heappop(parts)
        for half in _halves(largest):
            heapq.heappush(parts, (-ConvexHull(half).volume, next(tie), half))
    return [part for _, _, part in sorted(parts)]


def _halves(vertices: Vertices) -> tuple[Vertices, Vertices]:
    """Both sides of the plane through the middle of the longest side."""
    low, high = vertices.min(0), vertices.max(0)
    axis = int((high - low).argmax())
    height = vertices[:, axis] - (low + high)[axis] / 2
    rim = _crossings(vertices, height)
    below = np.concatenate([vertices[height <= 0], rim])
    above = np.concatenate([vertices[height >= 0], rim])
    return _corners(below), _corners(above)


def _crossings(vertices: Vertices, height: NDArray[np.float64]) -> Vertices:
    """Points where edges of the hull pass height 0."""
    faces = ConvexHull(vertices).simplices
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    start, end = edges[height[edges].prod(-1) < 0].T
    share = height[start] / (height[start] - height[end])
    return vertices[start] + share[:, None] * (vertices[end] - vertices[start])


def _corners(vertices: Vertices) -> Vertices:
    return vertices[ConvexHull(vertices).vertices]


# Both collections use both hands; with one object a motion, one of them is parked.
KINDS = {
    1: "pick_box_right,pick_cylinder_left",
    2: "pick_box_cylinder_both,turn_box_cylinder_both",
}
MAX_HULLS = 16


def bench_library(objects: int, hulls: int, *, folder: Path | None = None) -> Path:
    """Make, once, a procedural collection of two motions, and return its folder.

    The motions, their references and their physics are the same for every number of
    hulls: the convex bodies of the objects are only cut into more parts. Two objects a
    motion are carried by two hands. The folder is ``bench`` in the cache when None.
    """
    if objects not in KINDS or not 1 <= hulls <= MAX_HULLS:
        raise FlashdexError(
            f"bench: {objects} objects of {hulls} hulls cannot be made. Allowed: "
            f"--objects 1 or 2, --hulls 1 to {MAX_HULLS}."
        )
    folder = folder or default_cache_dir() / "bench"
    path = folder / f"xhand-o{objects}-h{hulls}"
    if not _is_usable(path):
        base = folder / f"xhand-o{objects}-base"
        if not _is_usable(base):
            options = SourceOptions(path=Path(KINDS[objects]))
            run_order(Order("procedural", options), base)
        recut_library(MotionLibrary.load(base), hulls, path)
    return path


def _is_usable(path: Path) -> bool:
    try:
        MotionLibrary.load(path)
    except LibraryError:
        return False
    return True


def recut_library(library: MotionLibrary, hulls: int, path: Path) -> MotionLibrary:
    """Write a library of convex objects anew, each cut into a number of parts."""
    manifest = {"source": "bench", "hulls": hulls}
    writer = LibraryWriter(path, hand=library.hand, fps=library.fps, manifest=manifest)
    assets = [_recut(library, row, hulls) for row in range(len(library.objects))]
    for motion in range(library.num_motions):
        writer.add(_record(library, motion, assets))
    return MotionLibrary.load(writer.write())


def _record(
    library: MotionLibrary, motion: int, assets: list[ObjectAsset]
) -> MotionRecord:
    row = library.motions[motion]
    start, length = int(row["start"]), int(row["length"])
    frames = library.frames[start : start + length]
    left, right = row["hand_active"].bool().tolist()
    left_slot, right_slot = row["hand_object"].tolist()
    return MotionRecord(
        name=library.names[motion],
        frames={str(k): np.array(v.numpy()) for k, v in frames.items()},
        hand_active=(left, right),
        hand_object=(left_slot, right_slot),
        objects=[assets[i] for i in row["object_index"].tolist() if i >= 0],
        support_disks=np.array(row["support_disks"].numpy()),
    )


def _recut(library: MotionLibrary, row: int, hulls: int) -> ObjectAsset:
    """An object of the library as it is, but for its parts."""
    entry: dict[str, Any] = library.manifest["objects"][row]
    values: dict[str, Any] = {
        str(key): value.numpy().copy() for key, value in library.objects[row].items()
    }
    for name in ("radius", "mass", "sdf_spacing"):
        values[name] = float(values[name])
    vertices = np.concatenate(library.parts(row))  # convex: one body, however cut
    visual = library.visual(row)
    return ObjectAsset(
        **values,
        name=entry["name"],
        parts=[part.astype(np.float32) for part in cut_hull(vertices, hulls)],
        watertight=entry["watertight"],
        sha256=f"{entry['sha256']}-{hulls}",
        visual_vertices=np.asarray(visual.vertices, np.float32),
        visual_faces=np.asarray(visual.faces, np.int32),
    )


def describe_scene(library: MotionLibrary) -> dict[str, Any]:
    """``motions``, ``objects`` of a world and ``hulls`` of each object slot."""
    rows = library.motions["object_index"].long()
    slots = (rows >= 0).any(0).nonzero().squeeze(-1).tolist()
    counts = {r: len(library.parts(r)) for r in rows.unique().tolist() if r >= 0}
    hulls = [max(counts[r] for r in rows[:, s].tolist() if r >= 0) for s in slots]
    return {"motions": library.num_motions, "objects": len(slots), "hulls": hulls}
