"""One hand carries one object: grasp, approach, lift, move, turn, place, retreat.

Every mesh has z up as it stands on the table, and its origin at the centre of its box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import (
    FINGER_RADIUS,
    Grasp,
    GraspTarget,
    fit_grasp,
)
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


# nominal durations, s
APPROACH, CLOSE, CARRY, RELEASE, RETREAT = 0.55, 0.30, 1.30, 0.25, 0.40
STANDOFF = 0.10  # m, how far the hand is away at the beginning and the end
# palm inclination against the grasp axis, rad: fingers point downwards or around
PALM_TILT = {"top": np.deg2rad(38), "side": np.deg2rad(35)}
FINGER_PITCH = 0.020
GAP = (0.003, 0.006)  # m, of the tips to the surface while grasping
OPENING = 0.5


@dataclass
class CarryPlan:
    """What happens to the object."""

    start: np.ndarray  # where it stands, m, (2,)
    move: np.ndarray  # horizontal displacement, m, (2,)
    lift: float  # highest point of the carry above the start, m
    turn: float  # rotation about z between start and end, rad
    tilt: float  # largest inclination in mid carry, rad
    yaw: float  # direction of the grasp axis (thumb to fingers) in the world, rad
    speed: float  # 1 is the nominal pace


@dataclass
class Track:
    """Keypoints (T, 21, 3) of a right hand and the object's pose, world."""

    keypoints: np.ndarray
    object_pos: np.ndarray
    object_rot: Rotation

    def mirrored(self, mirror: np.ndarray) -> Track:
        """The motion seen in a mirror, S = diag(mirror): p' = S p, R' = S R S."""
        matrix = self.object_rot.as_matrix() * mirror[:, None] * mirror[None, :]
        rot = Rotation.from_matrix(matrix)
        return Track(self.keypoints * mirror, self.object_pos * mirror, rot)


def carry_track(
    shape: Shape, plan: CarryPlan, rng: np.random.Generator, *, fps: float
) -> Track:
    """Noise-free motion of a right hand that carries ``shape`` as planned."""
    grasp = fit_grasp(grasp_target(shape, rng))
    ends = np.cumsum([APPROACH, CLOSE, CARRY, RELEASE, RETREAT]) * plan.speed
    times = np.arange(int(ends[-1] * fps) + 1) / fps
    rest = -shape.mesh.bounds[0, 2]
    pos, rot = _object_path(plan, times, ends, rest)
    opening = 1 - smooth(times, ends[0] - 0.10, ends[1] - 0.02)
    opening = opening + smooth(times, ends[2] + 0.02, ends[3] + 0.08)
    away = 1 - smooth(times, 0.0, ends[0]) + smooth(times, ends[3], ends[4])
    local = _hand_path(grasp, shape, opening, away, rest)
    points = np.einsum("tij,tkj->tki", rot.as_matrix(), local) + pos[:, None]
    return Track(points, pos, rot)


def smooth(times: np.ndarray, start: float, end: float) -> np.ndarray:
    """Minimum-jerk step from 0 to 1: s = 10 u^3 - 15 u^4 + 6 u^5."""
    u = np.clip((times - start) / (end - start), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _object_path(
    plan: CarryPlan, times: np.ndarray, ends: np.ndarray, rest: float
) -> tuple[np.ndarray, Rotation]:
    start, span = ends[1], ends[2] - ends[1]
    along = smooth(times, start + 0.15 * span, start + 0.85 * span)
    up = smooth(times, start, start + 0.45 * span)
    up = up - smooth(times, start + 0.55 * span, ends[2])
    pos = np.zeros((len(times), 3))
    pos[:, :2] = plan.start + along[:, None] * plan.move
    pos[:, 2] = rest + plan.lift * up
    middle = smooth(times, start + 0.15 * span, start + 0.5 * span)
    middle = middle - smooth(times, start + 0.5 * span, start + 0.85 * span)
    yaw = Rotation.from_rotvec(np.outer(plan.yaw + along * plan.turn, [0, 0, 1]))
    # inclination about the grasp axis: the object stays between thumb and fingers
    return pos, yaw * Rotation.from_rotvec(np.outer(middle * plan.tilt, [1, 0, 0]))


def _hand_path(
    grasp: Grasp, shape: Shape, opening: np.ndarray, away: np.ndarray, rest: float
) -> np.ndarray:
    share = _largest_opening(grasp, rest)
    steps = np.linspace(0, 1, 33)
    shapes = np.stack([grasp.opened(step * share) for step in steps])
    place = np.clip(opening, 0, 1) * (len(steps) - 1)
    low = np.minimum(place.astype(int), len(steps) - 2)
    part = (place - low)[:, None, None]
    points = (1 - part) * shapes[low] + part * shapes[low + 1]
    back = np.array([0.0, 0.0, 1.0])
    if shape.approach == "side":
        back = np.array([0.0, -0.95, 0.31])
    return points + STANDOFF * away[:, None, None] * back


def _largest_opening(grasp: Grasp, rest: float) -> float:
    """Share of the open posture that keeps all fingers off the table."""
    for share in np.linspace(OPENING, 0.1, 9):
        if grasp.opened(share)[:, 2].min() > -rest + FINGER_RADIUS:
            return float(share)
    return 0.1


def grasp_target(shape: Shape, rng: np.random.Generator) -> GraspTarget:
    """Fingertips on opposite sides of the object, palm inclined towards it."""
    across = shape.across
    approach = np.array(
        [0.0, 0.0, -1.0] if shape.approach == "top" else [0.0, 1.0, 0.0]
    )
    tilt = PALM_TILT[shape.approach]
    x = np.cos(tilt) * across + np.sin(tilt) * approach
    z = np.cos(tilt) * approach - np.sin(tilt) * across
    y = np.cross(z, x)
    floor = float(shape.mesh.bounds[0, 2])
    centre = np.array([0.0, 0.0, floor + shape.height])
    gap = rng.uniform(*GAP)
    tips = np.full((5, 3), np.nan)
    tips[0] = _touch(shape, centre, -across) - gap * across
    for i in range(shape.fingers):
        lateral = FINGER_PITCH * (i - (shape.fingers - 1) / 2)
        tips[i + 1] = _touch(shape, centre + lateral * y, across) + gap * across
    mesh = shape.mesh
    surface, faces, *_ = trimesh.sample.sample_surface(mesh, 1500, seed=0)
    normals = np.asarray(mesh.face_normals)[faces]
    palm = np.stack([x, y, z], axis=-1)
    return GraspTarget(tips, palm, np.asarray(surface), normals, floor)


def _touch(shape: Shape, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """First surface point met from far out along -direction towards ``point``."""
    origin = point + 0.5 * direction
    hits, _, _ = shape.mesh.ray.intersects_location([origin], [-direction])
    return hits[np.argmin(np.linalg.norm(hits - origin, axis=-1))]
