"""Distance grids of a motion's objects, of their meshes or filled as they collide."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial import ConvexHull

from flashdex.geometry.sdf import SdfGrid
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.meshes import join_meshes
from flashdex.objects.signed_distance import surface_distance

# nodes farther from the mesh keep its distance: parts bulge by less, m
BULGE = 0.03
_known: dict[str, np.ndarray] = {}  # by the object's hash: many motions share objects


def make_slot_grid(assets: list[ObjectAsset], *, solid: bool) -> SdfGrid:
    """Distance grids of a motion's objects in float64, row = slot.

    With ``solid`` they are of mesh and convex parts together, else of the mesh alone.
    """
    values = [_solid_values(a) if solid else a.sdf for a in assets]
    return SdfGrid(
        torch.tensor(np.stack(values)).double(),
        torch.tensor(np.stack([a.sdf_origin for a in assets])).double(),
        torch.tensor([float(a.sdf_spacing) for a in assets]).double(),
    )


def _solid_values(asset: ObjectAsset) -> np.ndarray:
    """Signed distance to the union of a mesh and its convex parts, m, (R, R, R).

    Convex parts fill handles and hollows. Outside of all of them the distance is exact;
    inside, it is the depth in the part one is deepest in, min_k max_i (n_i . p + d_i).
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
