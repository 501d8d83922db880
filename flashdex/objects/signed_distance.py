"""Signed distance of a triangle mesh on a regular cubic grid (numpy and scipy)."""

from __future__ import annotations

from typing import cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import KDTree

Array = NDArray[np.float64]

NEIGHBOURS = (4, 16, 64)  # samples tried around a node until its distance is proven
NODE_CHUNK = 1024  # nodes whose candidate triangles are held at once: in the cache
WINDING_PAIRS = 200_000  # node-triangle pairs held at once


def make_distance_grid(
    mesh: trimesh.Trimesh, *, resolution: int, margin: float, watertight: bool
) -> tuple[NDArray[np.float32], Array, float]:
    """Sample the signed distance on a cube around the mesh, in the mesh's frame.

    Distances are exact point-triangle distances (see :func:`surface_distance`); the
    sign is that of the generalised winding number minus one half.

    Of a watertight mesh one sign serves each region that it bounds; otherwise every
    node in the bounding box decides alone. There are R = ``resolution`` nodes an axis.

    Returns:
        Values at the nodes, m, negative inside, (R, R, R), axes x, y, z; node
        (0, 0, 0), m, (3,); node spacing, m.
    """
    low, high = mesh.bounds
    side = float((high - low).max()) + 2 * margin
    spacing = side / (resolution - 1)
    origin = 0.5 * (low + high) - 0.5 * side
    axis = np.arange(resolution) * spacing
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1) + origin
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    distance = surface_distance(mesh, nodes.reshape(-1, 3), step=spacing)
    distance = distance.reshape(nodes.shape[:3])
    if watertight:
        inside = _inside_by_component(triangles, nodes, distance, spacing)
    else:  # holes join inside and outside
        inside = ((nodes > low) & (nodes < high)).all(axis=-1)
        inside[inside] = winding_number(triangles, nodes[inside]) > 0.5
    values = np.where(inside, -distance, distance).astype(np.float32)
    return values, origin, spacing


def surface_distance(mesh: trimesh.Trimesh, points: Array, *, step: float) -> Array:
    """Unsigned distance from points to the nearest triangle.

    Triangles, edges and corners are sampled no farther than ``step`` apart, which puts
    every surface point within ``h = step / sqrt(3)`` of a sample of its own feature.
    By Pythagoras a triangle at distance d has a sample within ``sqrt(d^2 + h^2)``, so
    the best triangle among the k nearest samples is the nearest of all once the k-th
    sample is farther than that. Where even 64 samples prove nothing (a medial axis)
    the result is at most ``h^2 / (2 d)`` too large.

    Args:
        mesh: triangles, m.
        points: m, (N, 3).
        step: largest distance between neighbouring samples, m.
    """
    area = mesh.area_faces
    faces = mesh.faces[area > 1e-12 * area.max()]
    frames = _triangle_frames(mesh.vertices[faces])
    samples, first, owners, cover = _surface_samples(mesh.vertices, faces, step)
    tree = KDTree(samples)
    best = np.full(len(points), np.inf)
    proven = np.zeros(len(points), dtype=bool)
    for k in NEIGHBOURS:
        k = min(k, len(samples))
        todo = np.flatnonzero(~proven)
        for start in range(0, len(todo), NODE_CHUNK):
            part = todo[start : start + NODE_CHUNK]
            reach, sample = map(np.asarray, tree.query(points[part], k=k))
            best[part] = _best_of(points[part], sample, first, owners, frames)
            proven[part] = reach[:, -1] ** 2 >= best[part] ** 2 + cover**2
    return best


def triangle_distance(triangles: Array, points: Array) -> Array:
    """Unsigned distance from few points (N, 3) to the nearest of (F, 3, 3), m, (N,).

    Each is compared with each; see ``surface_distance`` for many points.
    """
    sides = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
    frames = _triangle_frames(triangles[area > 1e-12 * area.max()])
    return np.sqrt([_squared_distance(p, frames).min(initial=np.inf) for p in points])


def winding_number(triangles: Array, points: Array) -> Array:
    """Generalised winding number: the share of the sphere of view the mesh covers.

    ``w(p) = sum_f atan2(det(a, b, c), |a||b||c| + (a.b)|c| + (b.c)|a| + (c.a)|b|)``
    ``/ 2 pi`` (van Oosterom and Strackee 1983; Jacobson et al. 2013, Eq. 6)
    with a, b, c the corners seen from p: 1 inside, 0 outside a closed mesh. The dot
    products come from the lengths, ``a.b = (|a|^2 + |b|^2 - |a-b|^2) / 2``.

    Args:
        triangles: m, (F, 3, 3), counter-clockwise seen from outside.
        points: m, (N, 3).
    """
    centre = triangles.reshape(-1, 3).mean(axis=0)
    corners = (triangles - centre).astype(np.float32)
    where = (points - centre).astype(np.float32)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    height = (normal * a).sum(axis=-1)
    ab, bc, ca = (((u - v) ** 2).sum(-1) for u, v in ((a, b), (b, c), (c, a)))
    total = np.empty(len(points))
    chunk = max(1, WINDING_PAIRS // len(triangles))
    for start in range(0, len(points), chunk):
        p = where[start : start + chunk]
        aa, bb, cc = (((p[:, None] - u) ** 2).sum(-1) for u in (a, b, c))
        la, lb, lc = np.sqrt(aa), np.sqrt(bb), np.sqrt(cc)
        bottom = la * lb * lc + 0.5 * (
            (aa + bb - ab) * lc + (bb + cc - bc) * la + (cc + aa - ca) * lb
        )
        top = height - p @ normal.T
        total[start : start + chunk] = np.arctan2(top, bottom).sum(axis=-1)
    return total / (2 * np.pi)


def _inside_by_component(
    triangles: Array, nodes: Array, distance: Array, spacing: float
) -> NDArray[np.bool_]:
    # Two neighbouring nodes that are both farther than half a spacing from the surface
    # lie on the same side of it, so one winding number serves a connected region.
    far = distance > 0.5001 * spacing
    regions, count = cast(tuple[NDArray[np.int32], int], label(far))
    inside = np.zeros(distance.shape, dtype=bool)
    inside[~far] = winding_number(triangles, nodes[~far]) > 0.5
    order = np.argsort(distance, axis=None)
    deepest = np.zeros(count + 1, dtype=np.int64)
    deepest[regions.ravel()[order]] = order  # the last written is the farthest
    sign = winding_number(triangles, nodes.reshape(-1, 3)[deepest]) > 0.5
    return np.where(far, sign[regions], inside)


def _surface_samples(
    vertices: Array, faces: NDArray[np.int64], step: float
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], float]:
    """Samples (S, 3), their triangles as offsets and indices, and the cover radius."""
    corners = vertices[faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=-1)
    pieces = np.ceil(edge / step).astype(np.int64).clip(1)
    points, ids = [vertices], [faces.ravel()]
    owners = [np.repeat(np.arange(len(faces)), 3)]
    count = len(vertices)
    for n in np.unique(pieces[pieces > 1]):
        i, j = (g.ravel() for g in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        corner = (i == n) | (j == n) | (i + j == 0)
        keep = (i + j <= n) & ~corner
        weight = np.stack((n - i - j, i, j), axis=-1)[keep] / n
        chosen = np.flatnonzero(pieces == n)
        new = (weight @ corners[chosen]).reshape(-1, 3)
        points.append(new)
        ids.append(count + np.arange(len(new)))
        owners.append(np.repeat(chosen, len(weight)))
        count += len(new)
    sample, owner = np.concatenate(ids), np.concatenate(owners)
    order = np.argsort(sample, kind="stable")
    first = np.searchsorted(sample[order], np.arange(count + 1))
    cover = float((edge / pieces).max()) / np.sqrt(3)
    return np.concatenate(points), first, owner[order], cover


def _triangle_frames(corners: Array) -> Array:
    """Per triangle: origin, axes e1, e2, n, corner coordinates l, x2, y2, (F, 15)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    length = np.linalg.norm(b - a, axis=-1, keepdims=True)
    e1 = (b - a) / length
    e2 = np.cross(n, e1)
    x2, y2 = (((c - a) * e).sum(axis=-1, keepdims=True) for e in (e1, e2))
    return np.concatenate((a, e1, e2, n, length, x2, y2), axis=-1)


def _best_of(
    points: Array,
    sample: NDArray[np.int64],
    first: NDArray[np.int64],
    owners: NDArray[np.int64],
    frames: Array,
) -> Array:
    """Distance (N,) to the nearest triangle that owns one of the samples (N, k)."""
    degree = first[sample + 1] - first[sample]
    flat = degree.ravel()
    ends = np.cumsum(flat)
    within = np.arange(ends[-1]) - np.repeat(ends - flat, flat)
    triangle = owners[np.repeat(first[sample].ravel(), flat) + within]
    per_point = degree.sum(axis=-1)
    squared = _squared_distance(np.repeat(points, per_point, axis=0), frames[triangle])
    # A vertex that belongs to no triangle has degree 0: a point may have no candidate.
    best = np.full(len(points), np.inf)
    some = np.flatnonzero(per_point)
    starts = (np.cumsum(per_point) - per_point)[some]
    best[some] = np.minimum.reduceat(squared, starts)
    return np.sqrt(best)


def _squared_distance(points: Array, frames: Array) -> Array:
    delta = points - frames[:, :3]
    x, y, z = (np.einsum("ij,ij->i", delta, frames[:, k : k + 3]) for k in (3, 6, 9))
    length, x2, y2 = frames[:, 12], frames[:, 13], frames[:, 14]
    zero = np.zeros_like(x)
    edges = (
        _squared_to_segment(x, y, length, zero),
        _squared_to_segment(x, y, x2, y2),
        _squared_to_segment(x - length, y, x2 - length, y2),
    )
    inside = (y >= 0) & (x * y2 >= y * x2) & ((x - length) * y2 <= y * (x2 - length))
    return np.where(inside, 0.0, np.minimum.reduce(edges)) + z * z


def _squared_to_segment(x: Array, y: Array, dx: Array, dy: Array) -> Array:
    share = ((x * dx + y * dy) / (dx * dx + dy * dy)).clip(0, 1)
    return (x - share * dx) ** 2 + (y - share * dy) ** 2
