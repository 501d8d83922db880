"""Fewer triangles by collapsing edges: a closed mesh stays closed."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PULL = 1e-3  # of a quadric's size, towards the middle of the edge: flat parts are loose
LEAST_COSINE = 0.3  # between a triangle's normal before and after
SHARE = 0.5  # of the edges, the cheaper ones, that a round may collapse
MAX_ERROR = 0.005  # root mean square distance to the planes, share of the longest side
MAX_ROUNDS = 200


def simplify(mesh: trimesh.Trimesh, *, max_faces: int) -> trimesh.Trimesh:
    """A mesh of at most so many triangles where its shape allows it; a new one.

    Collapses edges, cheapest first, to the point nearest to the planes of all triangles
    that met there (Garland and Heckbert 1997), in rounds of edges that share no
    triangle. Edges with other than two triangles stay, and so do those whose collapse
    would pinch the surface (link condition) or turn a triangle over.
    """
    vertices = np.array(mesh.vertices, dtype=np.float64)
    faces = np.array(mesh.faces, dtype=np.int64)
    middle = vertices.mean(axis=0)
    vertices -= middle
    limit = MAX_ERROR * float(mesh.extents.max())
    quadrics = _quadrics(vertices, faces)
    refused = np.empty(0, dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        if len(faces) <= max_faces:
            break
        edges = _free_edges(faces, len(vertices))
        keys = edges @ np.array([len(vertices), 1])
        edges = edges[~np.isin(keys, refused)]
        if not len(edges):
            break
        cost, target = _targets(vertices, quadrics, edges, limit)
        count = (len(faces) - max_faces + 1) // 2
        chosen = _apart(edges, cost, len(vertices))[:count]
        chosen = chosen[np.isfinite(cost[chosen])]
        if not len(chosen):
            break
        bad = _turned_over(vertices, faces, edges[chosen], target[chosen])
        refused = np.append(refused, edges[chosen[bad]] @ np.array([len(vertices), 1]))
        kept = edges[chosen[~bad]]
        vertices[kept[:, 0]] = target[chosen[~bad]]
        quadrics[kept[:, 0]] += quadrics[kept[:, 1]]
        place = np.arange(len(vertices))
        place[kept[:, 1]] = kept[:, 0]
        faces = place[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    new = trimesh.Trimesh(vertices + middle, faces, process=False)
    new.remove_unreferenced_vertices()
    return new


def _quadrics(vertices: Array, faces: Index) -> Array:
    """Per vertex: sum of squared distances to its planes, as (N, 4, 4)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(area, 1e-30)
    plane = np.hstack([normal, -(normal * a).sum(axis=1, keepdims=True)])
    each = area[:, :, None] * plane[:, :, None] * plane[:, None, :]
    total = np.zeros((len(vertices), 4, 4))
    for i in range(3):
        np.add.at(total, faces[:, i], each)
    return total


def _free_edges(faces: Index, count: int) -> Index:
    """Edges (E, 2) that can go: two triangles, ends inside, and no pinch."""
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys, uses = np.unique(pairs @ np.array([count, 1]), return_counts=True)
    edges = np.stack(np.divmod(keys, count), axis=1)
    locked = np.zeros(count, dtype=bool)
    locked[edges[uses != 2]] = True
    both = np.vstack([edges, edges[:, ::-1]])
    linked = csr_matrix((np.ones(len(both), np.int32), both.T), shape=(count, count))
    edges = edges[~locked[edges].any(axis=1)]
    common = linked[edges[:, 0]].multiply(linked[edges[:, 1]]).sum(axis=1)
    return edges[np.asarray(common).ravel() == 2]


def _targets(
    vertices: Array, quadrics: Array, edges: Index, limit: float
) -> tuple[Array, Array]:
    """What each edge's collapse costs, (E,), and where it goes, (E, 3).

    Beyond the limit, m, of the mean distance to the planes the cost is infinite.
    """
    total = quadrics[edges].sum(axis=1)
    middle = vertices[edges].mean(axis=1)
    pull = PULL * np.trace(total[:, :3, :3], axis1=1, axis2=2) + 1e-30
    matrix = total[:, :3, :3] + pull[:, None, None] * np.eye(3)
    side = pull[:, None] * middle - total[:, :3, 3]
    target = np.linalg.solve(matrix, side[:, :, None])[:, :, 0]
    length = np.square(np.diff(vertices[edges], axis=1)).sum(axis=(1, 2))
    # planes that are nearly one meet far away
    far = np.square(target - middle).sum(axis=1) > length
    target[far] = middle[far]
    point = np.hstack([target, np.ones((len(target), 1))])
    cost = np.einsum("ei,eij,ej->e", point, total, point)
    weight = np.trace(total[:, :3, :3], axis1=1, axis2=2)  # area: normals are unit
    # the length decides where all is flat
    ranked = cost + 1e-3 * pull * length
    return np.where(cost > limit**2 * weight, np.inf, ranked), target


def _apart(edges: Index, cost: Array, count: int) -> Index:
    """Edges of which no two meet in a triangle, cheapest first."""
    rank = np.empty(len(edges), dtype=np.int64)
    rank[np.argsort(cost, kind="stable")] = np.arange(len(edges))
    least = np.full(count, len(edges))
    for end in edges.T:
        np.minimum.at(least, end, rank)
    around = least.copy()
    for one, other in (edges.T, edges.T[::-1]):
        np.minimum.at(around, one, least[other])
    best = np.flatnonzero(around[edges].min(axis=1) == rank)
    best = best[np.argsort(rank[best])]
    return best[rank[best] <= max(SHARE * len(edges), rank[best[0]])]


def _turned_over(
    vertices: Array, faces: Index, edges: Index, target: Array
) -> NDArray[np.bool_]:
    """Whether an edge's collapse would turn a triangle over or flatten it, (E,)."""
    owner = np.full(len(vertices), -1)
    owner[edges] = np.arange(len(edges))[:, None]
    after = vertices.copy()
    after[edges] = target[:, None]
    owners = owner[faces]
    touched = ((owners >= 0).sum(axis=1)) == 1  # those with two are to vanish
    triangles = faces[touched]
    old, new = (_normals(v[triangles]) for v in (vertices, after))
    size = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    turned = (old * new).sum(axis=1) <= LEAST_COSINE * size
    bad = np.zeros(len(edges), dtype=bool)
    bad[owners[touched].max(axis=1)[turned]] = True
    return bad


def _normals(corners: Array) -> Array:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
