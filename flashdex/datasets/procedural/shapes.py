"""Objects of the procedural collection: meshes at rest, and how to hold them.

Every mesh has z up as it stands on the table, and its origin at the centre of its box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh

from flashdex.objects.meshes import join_meshes

Approach = Literal["top", "side"]


@dataclass
class Shape:
    """A mesh and the grasp that suits it."""

    mesh: trimesh.Trimesh  # metres, rest pose, centred
    approach: Approach  # from above across the object, or from the side around it
    height: float  # of the contacts above the object's lowest point, m
    across: np.ndarray  # grasp axis in the object frame, unit, horizontal (3,)
    fingers: int  # how many fingers oppose the thumb


X_AXIS = np.array([1.0, 0.0, 0.0])


def _centred(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def box(rng: np.random.Generator) -> Shape:
    """A box 4.5-6 cm wide across the grasp, longer along it."""
    size = rng.uniform([0.045, 0.060, 0.055], [0.060, 0.085, 0.075])
    return Shape(trimesh.creation.box(size), "top", 0.6 * size[2], X_AXIS, 3)


def cylinder(rng: np.random.Generator) -> Shape:
    """A standing cylinder of 5-6 cm diameter, held from the side."""
    radius, height = rng.uniform(0.025, 0.030), rng.uniform(0.11, 0.14)
    mesh = trimesh.creation.cylinder(radius, height, sections=48)
    return Shape(mesh, "side", 0.60 * height, X_AXIS, 3)


def sphere(rng: np.random.Generator) -> Shape:
    """A ball of 5.5-6.5 cm diameter, held from above."""
    radius = rng.uniform(0.0275, 0.0325)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Shape(mesh, "top", 0.95 * radius, X_AXIS, 3)


def capsule(rng: np.random.Generator) -> Shape:
    """A lying capsule, 4.5-5.5 cm thick and about 10 cm long along y."""
    radius, length = rng.uniform(0.0225, 0.0275), rng.uniform(0.04, 0.06)
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[24, 24])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, X_AXIS))
    return Shape(_centred(mesh), "top", radius, X_AXIS, 3)


def bowl(rng: np.random.Generator) -> Shape:
    """A small steep bowl of at most 6.5 cm diameter, held across from above."""
    outer, height = rng.uniform(0.030, 0.0325), rng.uniform(0.045, 0.055)
    wall, base = 0.005, 0.006
    profile = [
        [0.0, 0.0],
        [0.75 * outer, 0.0],
        [0.93 * outer, 0.35 * height],
        [outer, height],
        [outer - wall, height],
        [0.93 * outer - wall, 0.35 * height],
        [0.65 * outer, base],
        [0.0, base],
    ]
    mesh = trimesh.creation.revolve(np.array(profile), sections=48)
    return Shape(_centred(mesh), "top", 0.65 * height, X_AXIS, 3)


def spoon(rng: np.random.Generator) -> Shape:
    """A thick handle along y with a bulb at its end, resting on bulb and handle end."""
    handle, bulb = rng.uniform(0.013, 0.015), rng.uniform(0.024, 0.027)
    length = rng.uniform(0.11, 0.13)
    stick = trimesh.creation.capsule(height=length, radius=handle, count=[20, 20])
    head = trimesh.creation.icosphere(subdivisions=3, radius=bulb)
    head.apply_scale([1.0, 1.0, 0.8])
    stick.apply_translation([0.0, 0.0, -length])  # the bulb's centre is the origin
    turn = trimesh.transformations.rotation_matrix
    stick.apply_transform(turn(np.pi / 2, X_AXIS))
    # both ends on the table: the handle falls by (0.8 bulb - handle) over its length
    tilt = np.arcsin((0.8 * bulb - handle) / length)
    mesh = join_meshes([stick, head])
    mesh.apply_transform(turn(-tilt, X_AXIS))
    mesh = _centred(mesh)
    hits, _, _ = mesh.ray.intersects_location([[0, 0, 1.0]], [[0, 0, -1.0]])
    height = hits[:, 2].mean() + 0.002 - mesh.bounds[0, 2]  # of the handle's axis
    return Shape(mesh, "top", float(height), X_AXIS, 2)


SHAPES: dict[str, Callable[[np.random.Generator], Shape]] = {
    "box": box,
    "cylinder": cylinder,
    "sphere": sphere,
    "capsule": capsule,
    "bowl": bowl,
    "spoon": spoon,
}
