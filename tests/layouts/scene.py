"""One physical motion in closed form, which every layout writer puts into its files.

World z up, right-handed, metres. A box 8 x 6 x 4 cm lies on a table; the right hand
reaches it at 0.5 s, lifts it by 15 cm with 30 degrees of yaw, puts it down and leaves.
The left hand does so with a second, smaller body. While a hand carries, it is rigid to
its object. The finger poses are mean + 15 principal components, so that every pose
convention can express them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from layouts.mano_files import flexions, mano_hand
from layouts.reference_fk import rodrigues, shaped, wrist_keypoints

TABLE_Z = 0.52
REACHED = 0.5  # s, after the start and before the end
BETAS = np.array([0.9, -0.6, 0.4, 0.8, -0.5, 0.3, -0.7, 0.6, -0.2, 0.5])
NAMES = ("box", "block")
# m; the second body's origin is not its centre: transforms of meshes must be applied
HALVES = np.array([[0.04, 0.03, 0.02], [0.035, 0.025, 0.03]])
ORIGINS = np.array([[0.0, 0.0, 0.0], [0.012, -0.007, 0.02]])
PLACES = np.array([[0.31, -0.17], [0.28, 0.19]])  # on the table, m
LIFTS, YAWS = (0.15, 0.10), (np.deg2rad(30), np.deg2rad(-20))

# Found once by least squares (tips on the faces, nothing below the table): wrist in the
# frame of the box's centre, m; turn of the root and flexion of the joints, rad.
GRASPS = {
    "right": ([0.0498, -0.1073, 0.0342], [1.595, -1.02, -0.748]),
    "left": ([-0.0381, -0.1026, 0.0288], [1.65, 1.046, 0.796]),
}
# joints 1-15: index, middle, pinky, ring, thumb; three a line
FLEXIONS = {
    "right": """
        0     0.315 0.745
        0     0.736 1.2
        0.351 0.717 0.322
        0.138 0.658 1.2
        0.155 -0.6 -0.6""",
    "left": """
        0     0.276 1.175
        0     0.985 1.174
        0.575 0.473 0.507
        0.237 0.79  1.014
        0.011 -0.6  -0.6""",
}
OPENING = -0.25  # rad, of each joint before and after the grasp
AWAY = np.array([0.0, -0.01, 0.15])  # m, from there the hand comes
IDLE = np.array([-0.35, 0.25, 0.12])  # m, from object 0: a hand without an object


@dataclass
class SceneHand:
    """A hand of the scene.

    Args:
        rotations: of the root in the world, of the joints in their parents; flat hand
            = identity, (T, 16, 3, 3).
        axis_angle: the same, (T, 48).
        wrist: position of the wrist joint in the world, m, (T, 3).
        j0: wrist joint at rest, m, (3,).
        betas: shape, (10,).
        keypoints: m, world, (T, 21, 3).
        coefficients: of the first 15 components, to be added to the mean, (T, 15).
    """

    rotations: np.ndarray
    axis_angle: np.ndarray
    wrist: np.ndarray
    j0: np.ndarray
    betas: np.ndarray
    keypoints: np.ndarray
    coefficients: np.ndarray


@dataclass
class SceneObject:
    """A rigid body: mesh in its own frame (m), pose in the world (T, 7), wxyz."""

    name: str
    mesh: trimesh.Trimesh
    pose: np.ndarray


@dataclass
class Scene:
    """The motion at one frame rate; see the module."""

    fps: float
    times: np.ndarray
    hands: dict[str, SceneHand]
    objects: list[SceneObject]
    table_z: float


def make_scene(
    fps,
    *,
    seconds=3.0,
    hands=("left", "right"),
    num_objects=2,
    fix_left_shape=False,
    table_z=TABLE_Z,
):
    """The scene at ``fps``; the motion depends on ``seconds``, never on ``fps``."""
    times = np.arange(round(seconds * fps)) / fps
    objects = [
        _make_object(i, times, seconds, table_z, moves=("right", "left")[i] in hands)
        for i in range(num_objects)
    ]
    made = {}
    for side in hands:
        slot = 0 if side == "right" or num_objects == 1 else 1
        idle = side == "left" and num_objects == 1
        hand = mano_hand(side, fix_left_shape=fix_left_shape)
        made[side] = _make_hand(side, hand, objects[slot], times, seconds, idle)
    return Scene(fps, times, made, objects, table_z)


def step(times, start, end):
    """From 0 to 1 without a jump of velocity or acceleration."""
    x = np.clip((times - start) / (end - start), 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


def _make_object(index, times, seconds, table_z, *, moves):
    first, last = REACHED + 0.1, seconds - REACHED - 0.1
    middle = 0.5 * (first + last)
    rise = step(times, first, middle - 0.05) - step(times, middle + 0.05, last)
    turn = step(times, first + 0.1, last - 0.1)
    if not moves:
        rise, turn = 0 * times, 0 * times
    height = table_z + HALVES[index, 2] + LIFTS[index] * rise
    centre = np.stack([0.04 * turn, 0.03 * turn, height], axis=-1)
    centre[:, :2] += PLACES[index]
    angle = 0.2 - 0.5 * index + YAWS[index] * turn
    yaw = Rotation.from_euler("z", angle[:, None])
    pose = np.empty((len(times), 7))
    pose[:, :3] = centre - yaw.apply(-ORIGINS[index])
    pose[:, 3:] = yaw.as_quat(scalar_first=True)
    mesh = trimesh.creation.box(2 * HALVES[index]).subdivide()
    mesh.apply_translation(-ORIGINS[index])
    return SceneObject(NAMES[index], mesh, pose)


def _make_hand(side, hand, body, times, seconds, idle):
    """A hand rigid to its object while it carries, elsewhere on its way."""
    near = step(times, 0.0, REACHED) - step(times, seconds - REACHED, seconds)
    wrist, turn = (np.array(part) for part in GRASPS[side])
    pose, away = body.pose, AWAY
    if idle:
        near, away, pose = 0 * near, IDLE, np.repeat(pose[:1], len(pose), axis=0)
    body_turn = Rotation.from_quat(pose[:, 3:], scalar_first=True)
    centre = pose[:, :3] + body_turn.apply(-ORIGINS[NAMES.index(body.name)])
    place = centre + body_turn.apply(wrist + (1 - near)[:, None] * away)
    root = (body_turn * Rotation.from_rotvec(turn)).as_rotvec()
    bent = np.array(FLEXIONS[side].split(), dtype=float)
    bent = bent + (1 - near)[:, None] * OPENING
    # the flexions span the first 15 components; the mean adds the rest
    wanted = bent @ flexions(side) - hand.hands_mean
    coefficients = wanted @ hand.hands_components[:15].T
    fingers = hand.hands_mean + coefficients @ hand.hands_components[:15]
    axis_angle = np.concatenate([root, fingers], axis=1)
    rotations = np.array([[rodrigues(v) for v in f.reshape(16, 3)] for f in axis_angle])
    rest = shaped(hand, BETAS)
    return SceneHand(
        rotations=rotations,
        axis_angle=axis_angle,
        wrist=place,
        j0=hand.regressor[0] @ rest,
        betas=BETAS.copy(),
        keypoints=wrist_keypoints(side, hand, rest, rotations, place),
        coefficients=coefficients,
    )
