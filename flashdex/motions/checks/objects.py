"""Checks of the objects of a motion: size, closedness, convex parts, overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.spatial import ConvexHull

from flashdex.datasets.tracks import rotation
from flashdex.geometry.sdf import SdfGrid
from flashdex.motions.checks.recording import Finding, reject
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.symmetry import revolution_axis

EXTENTS = (0.005, 1.5)  # m, of a mesh
HOLLOW = 3.0  # volume of the convex hull over that of the mesh
LUMPED = 1.5  # the same ratio, from which one convex part is too few
MAX_PARTS = 32
OVERLAP = 0.02  # m, of two objects in the first frame


@dataclass(frozen=True)
class _Shape:
    """What is found out about a mesh once, however many motions use it."""

    hollow: float
    axis: np.ndarray | None


_known: dict[str, _Shape] = {}


def check_objects(assets: list[ObjectAsset]) -> list[Finding]:
    """Size, watertightness, convex parts and symmetry of the objects.

    Args:
        assets: the objects of a motion.
    """
    return [finding for asset in assets for finding in _check_object(asset)]


def _check_object(asset: ObjectAsset) -> list[Finding]:
    name, found = asset.name, []
    size = float((asset.aabb[1] - asset.aabb[0]).max())
    if not EXTENTS[0] < size < EXTENTS[1]:
        text = f"'{name}' is {size:.3g} m large; are these metres?"
        found.append(reject("E_UNIT", text))
    if not asset.watertight:
        found.append(Finding("W_WATER", "info", f"'{name}' is not watertight"))
    shape, count = _shape_of(asset), len(asset.parts)
    ratio = f"{'' if asset.watertight else 'about '}{shape.hollow:.1f}"
    if shape.hollow > HOLLOW and count > 1:
        text = f"'{name}' is hollow: hull/mesh volume {ratio}; {count} convex parts"
        found.append(Finding("W_HULL", "info", text))
    elif shape.hollow > HOLLOW:
        text = f"'{name}' is hollow (hull/mesh volume {ratio}), but one convex part"
        found.append(Finding("W_HULL", "warn", f"{text} fills it"))
    elif shape.hollow > LUMPED and count == 1:
        text = f"'{name}' collides as its hull, {ratio} times its volume: CoACD failed?"
        found.append(Finding("W_PARTS", "warn", text))
    if count > MAX_PARTS:
        text = f"'{name}' has {count} convex parts; more than {MAX_PARTS} are slow"
        found.append(Finding("W_PARTS", "warn", text))
    if shape.axis is not None:
        axis = " ".join(f"{x:.2f}" for x in shape.axis)
        text = f"'{name}' is a body of revolution about ({axis})"
        found.append(Finding("W_SYM", "info", text))
    return found


def _shape_of(asset: ObjectAsset) -> _Shape:
    if asset.sha256 not in _known:
        mesh = trimesh.Trimesh(
            np.asarray(asset.visual_vertices, float), asset.visual_faces, process=False
        )
        hull = float(ConvexHull(mesh.vertices).volume)
        hollow = hull / max(abs(float(mesh.volume)), 1e-3 * hull)
        _known[asset.sha256] = _Shape(hollow, revolution_axis(mesh))
    return _known[asset.sha256]


def check_overlap(
    assets: list[ObjectAsset], poses: list[np.ndarray], sdf: SdfGrid
) -> list[Finding]:
    """Objects that are inside of each other in the first frame.

    Args:
        assets: by slot.
        poses: by slot, (T, 7).
        sdf: distances of the meshes, by slot.
    """
    depth, pair = 0.0, (0, 0)
    for a, first in enumerate(assets):
        turn, shift = rotation(poses[a][0, 3:]), poses[a][0, :3]
        points = np.concatenate([first.points, first.visual_vertices]).astype(float)
        world = turn.apply(points) + shift
        for b in range(len(assets)):
            if b == a:
                continue
            local = rotation(poses[b][0, 3:]).inv().apply(world - poses[b][0, :3])
            distance, _ = sdf.query(torch.tensor(local), torch.tensor(b))
            deepest = -float(distance.min())
            if deepest > depth:
                depth, pair = deepest, (a, b)
    if depth <= OVERLAP:
        return []
    names = [assets[i].name for i in pair]
    text = f"'{names[0]}' is {1e3 * depth:.0f} mm inside '{names[1]}' in frame 0"
    return [Finding("W_OBJOBJ", "warn", text)]
