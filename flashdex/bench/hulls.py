"""A convex body cut into more convex bodies, as a decomposition would leave it."""

from __future__ import annotations

import heapq
import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Vertices = NDArray[np.float64]


def cut_hull(vertices: NDArray[np.floating], count: int) -> list[Vertices]:
    """Cut a convex body into parts that touch and do not overlap.

    The largest part is cut across its longest side until there are enough.

    Args:
        vertices: of the body, m, (V, 3).
        count: parts wanted.

    Returns:
        Vertices of each part, m, each (V, 3), largest volume first.

    Example:
        >>> box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
        >>> [len(part) for part in cut_hull(box, 2)]
        [8, 8]
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
    """Vertices of the hull, each once."""
    return vertices[ConvexHull(vertices).vertices]
