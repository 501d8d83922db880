"""Checks of the objects of a motion: size, closedness, convex parts, overlap."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import torch
import trimesh
from scipy.spatial import ConvexHull

from flashdex.datasets.tracks import rotation
from flashdex.geometry.sdf import SdfGrid
from flashdex.motions.findings import Finding, info, reject, warn
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.symmetry import revolution_axis

EXTENTS = (0.005, 1.5)  # m, of a mesh
HOLLOW = 3.0  # volume of the convex hull over that of the mesh
LUMPED = 1.5  # the same ratio, from which one convex part is too few
MAX_PARTS = 32
OVERLAP = 0.02  # m, of two objects in the first frame


# hull/mesh volume and axis of revolution by hash: found out once an object, however
# many motions use it
_known: dict[str, tuple[float, np.ndarray | None]] = {}


def check_objects(assets: list[ObjectAsset]) -> list[Finding]:
    """Size, watertightness, convex parts and symmetry of the objects of a motion."""
    return [finding for asset in assets for finding in _check_object(asset)]


def _check_object(asset: ObjectAsset) -> list[Finding]:
    name, found = asset.name, []
    size = float((asset.aabb[1] - asset.aabb[0]).max())
    if not EXTENTS[0] < size < EXTENTS[1]:
        text = f"'{name}' is {size:.3g} m large; are these metres?"
        found.append(reject("E_UNIT", text))
    if not asset.watertight:
        found.append(info("W_WATER", f"'{name}' is not watertight"))
    (hollow, axis), count = _shape_of(asset), len(asset.parts)
    ratio = f"{'' if asset.watertight else 'about '}{hollow:.1f}"
    if hollow > HOLLOW and count > 1:
        text = f"'{name}' is hollow: hull/mesh volume {ratio}; {count} convex parts"
        found.append(info("W_HULL", text))
    elif hollow > HOLLOW:
        text = f"'{name}' is hollow (hull/mesh volume {ratio}), but one convex part"
        found.append(warn("W_HULL", f"{text} fills it"))
    elif hollow > LUMPED and count == 1:
        text = f"'{name}' collides as its hull, {ratio} times its volume: CoACD failed?"
        found.append(warn("W_PARTS", text))
    if count > MAX_PARTS:
        text = f"'{name}' has {count} convex parts; more than {MAX_PARTS} are slow"
        found.append(warn("W_PARTS", text))
    if axis is not None:
        told = " ".join(f"{x:.2f}" for x in axis)
        text = f"'{name}' is a body of revolution about ({told})"
        found.append(info("W_SYM", text))
    return found


def _shape_of(asset: ObjectAsset) -> tuple[float, np.ndarray | None]:
    if asset.sha256 not in _known:
        vertices = np.asarray(asset.visual_vertices, float)
        mesh = trimesh.Trimesh(vertices, asset.visual_faces, process=False)
        hull = float(ConvexHull(mesh.vertices).volume)
        hollow = hull / max(abs(float(mesh.volume)), 1e-3 * hull)
        _known[asset.sha256] = hollow, revolution_axis(mesh)
    return _known[asset.sha256]


def check_overlap(
    assets: list[ObjectAsset], poses: list[np.ndarray], sdf: SdfGrid
) -> list[Finding]:
    """Objects that are inside of each other in the first frame; all by slot."""
    depth, pair = 0.0, (0, 0)
    turns = [rotation(pose[0, 3:]) for pose in poses]
    for a, b in permutations(range(len(assets)), 2):
        first = assets[a]
        points = np.concatenate([first.points, first.visual_vertices]).astype(float)
        world = turns[a].apply(points) + poses[a][0, :3]
        local = turns[b].inv().apply(world - poses[b][0, :3])
        distance, _ = sdf.query(torch.tensor(local), torch.tensor(b))
        if -float(distance.min()) > depth:
            depth, pair = -float(distance.min()), (a, b)
    if depth <= OVERLAP:
        return []
    names = [assets[i].name for i in pair]
    text = f"'{names[0]}' is {1e3 * depth:.0f} mm inside '{names[1]}' in frame 0"
    return [warn("W_OBJOBJ", text)]
