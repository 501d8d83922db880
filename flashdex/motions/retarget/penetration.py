"""How deep a joint reference is inside objects and table: MuJoCo's own collisions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from flashdex.hands.attach import add_hand
from flashdex.hands.spec import HandSpec
from flashdex.keys import SIDES, Side


@dataclass
class Penetration:
    """Depth of the deepest contact of each frame, m, zero without one, (T,) each."""

    objects: np.ndarray
    table: np.ndarray
    hands: np.ndarray
    own: np.ndarray


def make_reference_scene(
    specs: Mapping[Side, HandSpec], parts: list[list[np.ndarray]]
) -> mujoco.MjModel:
    """Both hands, a table at z = 0 and one mocap body ``object{slot}`` an object.

    The parts are vertices (V, 3), m, of an object's convex parts, by slot.
    """
    scene = mujoco.MjSpec()
    scene.option.gravity = np.zeros(3)
    for side in SIDES:
        add_hand(scene, specs[side])
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    scene.worldbody.add_geom(name="table", type=plane, size=[2.0, 2.0, 0.1])
    for slot, hulls in enumerate(parts):
        body = scene.worldbody.add_body(name=f"object{slot}", mocap=True)
        for i, vertices in enumerate(hulls):
            name = f"object{slot}_part{i}"
            scene.add_mesh(name=name, uservert=np.asarray(vertices, float).ravel())
            body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    return scene.compile()


def measure_penetration(
    model: mujoco.MjModel,
    joint_pos: np.ndarray,
    poses: list[np.ndarray],
    *,
    active: np.ndarray,
) -> Penetration:
    """Pose hands and objects frame by frame and read the contacts.

    Joint positions are (T, 2, J), poses (T, 7) a slot; ``active`` are hands that count.
    """
    data = mujoco.MjData(model)
    owner = _owners(model)
    counts = np.r_[active, np.ones(2, dtype=bool)]
    depth = np.zeros((len(joint_pos), 4, 4))
    for t in range(len(joint_pos)):
        data.qpos[:] = joint_pos[t].ravel()
        for slot, pose in enumerate(poses):
            data.mocap_pos[slot], data.mocap_quat[slot] = pose[t, :3], pose[t, 3:]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs = np.sort(owner[data.contact.geom], axis=1)
        gaps = np.maximum(-data.contact.dist, 0) * counts[pairs].all(axis=1)
        np.maximum.at(depth[t], (pairs[:, 0], pairs[:, 1]), gaps)
    return Penetration(
        objects=depth[:, :2, 2].max(axis=1),
        table=depth[:, :2, 3].max(axis=1),
        hands=depth[:, 0, 1],
        own=np.maximum(depth[:, 0, 0], depth[:, 1, 1]),
    )


def _owners(model: mujoco.MjModel) -> np.ndarray:
    """0 and 1 for geoms of the left and right hand, 2 for objects, 3 for the table."""
    prefixes = {"world": 3, "left": 0, "right": 1}
    names = [model.body(int(b)).name for b in model.geom_bodyid]
    return np.array([prefixes.get(n.split("_")[0], 2) for n in names])
