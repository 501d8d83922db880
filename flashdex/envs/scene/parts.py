"""Builders of one scene: options, objects, supports, contact sensors.

Each adds one kind of element to a ``mujoco.MjSpec``. What a motion lacks is filled with
a grain that nothing reaches: all scenes of a collection have the same elements.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from torch import Tensor

from flashdex import keys
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

# Bit masks of method section 5: hands meet hands and objects, objects meet objects.
HAND_BITS = (1, 1)
OBJECT_BITS = (2, 3)
_GRAIN = 1e-3  # m, radius of a geom that fills an unused place
# m; with its mass centre off the origin a body is never "simple", so that all scenes
# have the same inertia structure
INERTIA_OFFSET = 1e-5
_ROLLING = 1e-4  # m, MuJoCo's own; with condim 6 only
_SENSOR_DATA = 2 | 16  # bits of mjSENS_CONTACT: net force and position
_NET_FORCE = 3  # reduction: one wrench at the force-weighted point, world axes


def pad_bvh(spec: mujoco.MjSpec, nodes: int) -> None:
    """Add unused meshes, so that the scene has ``nodes`` more bounding volumes.

    A mesh of f faces has 2 f - 1 of them; their number is part of MuJoCo's data layout.
    """
    faces = [] if nodes == 0 else [(nodes + 1) // 2]
    if nodes and nodes % 2 == 0:
        faces = [1, nodes // 2]
    for i, count in enumerate(faces):
        step = np.arange(count + 3)
        vertices = np.stack([step * 0.01, step % 2 * 0.01, step % 3 * 0.003], -1)
        mesh = spec.add_mesh(name=f"filler{i}")
        mesh.uservert = vertices.reshape(-1)
        strip = np.arange(count)[:, None] + np.arange(3)
        mesh.userface = strip.reshape(-1).astype(np.int32)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def set_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    """Set time step, solver and contact model of a scene."""
    option = spec.option
    option.timestep = physics.timestep
    option.iterations = physics.iterations
    option.ls_iterations = physics.ls_iterations
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.__members__[f"mjSOL_{physics.solver.upper()}"]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = physics.impratio
    # A world that diverges is ended and counted; a silent reset would hide it.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.degree = False


def set_hand_friction(
    spec: mujoco.MjSpec, side: keys.Side, physics: PhysicsConfig
) -> None:
    """Give all geoms of one hand its collision bits and friction."""
    for geom in spec.geoms:
        if geom.parent.name.startswith(f"{side}_"):
            geom.contype, geom.conaffinity = HAND_BITS
            geom.friction = _friction(physics.friction, physics)


def _friction(sliding: float, physics: PhysicsConfig) -> list[float]:
    """Sliding, torsional and rolling; of a pair each counts the larger."""
    return [sliding, physics.torsional_friction, _ROLLING]


def add_object(
    spec: mujoco.MjSpec,  # scene under construction
    library: MotionLibrary,  # holds masses, inertias and convex parts
    row: int,  # object row of the library, -1 for an empty slot
    slot: int,  # object slot; the body is called ``object<slot>``
    num_parts: int,  # geoms of this slot in every scene of the collection
    physics: PhysicsConfig,  # friction and contact dimension
) -> None:
    """Add the free body of one object slot, with exactly ``num_parts`` geoms."""
    body = spec.worldbody.add_body(name=f"object{slot}")
    body.add_freejoint(name=f"object{slot}")
    parts = library.parts(row) if row >= 0 else []
    _set_inertia(body, library, row)
    inside = parts[0].mean(0) if parts else np.zeros(3)
    for i in range(num_parts):
        name = f"object{slot}_part{i}"
        if i >= len(parts):
            _add_grain(body, name, inside, OBJECT_BITS)
            continue
        add_part_mesh(spec, name, np.asarray(parts[i]))
        _add_part(body, name, name, slot, physics)


def add_part_mesh(spec: mujoco.MjSpec, name: str, vertices: np.ndarray) -> None:
    """Add one convex part as a mesh asset."""
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, np.float64).reshape(-1)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX


def _add_part(
    body: mujoco.MjsBody, name: str, mesh: str, slot: int, physics: PhysicsConfig
) -> None:
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh)
    geom.contype, geom.conaffinity = OBJECT_BITS
    geom.friction = _friction(physics.object_friction, physics)
    geom.condim = physics.condim
    geom.rgba = [0.85, 0.55, 0.25, 1.0] if slot == 0 else [0.3, 0.6, 0.4, 1.0]


def add_object_of_meshes(
    spec: mujoco.MjSpec, meshes: list[str], slot: int, physics: PhysicsConfig
) -> None:
    """Add the free body of one object slot whose parts are given mesh assets.

    Its mass is a placeholder: engines that swap objects write the numbers of the
    object a world holds.
    """
    body = spec.worldbody.add_body(name=f"object{slot}")
    body.add_freejoint(name=f"object{slot}")
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = 0.01, [1e-5] * 3, [INERTIA_OFFSET] * 3
    for i, mesh in enumerate(meshes):
        _add_part(body, f"object{slot}_part{i}", mesh, slot, physics)


def _set_inertia(body: mujoco.MjsBody, library: MotionLibrary, row: int) -> None:
    body.explicitinertial = True
    if row < 0:
        body.mass, body.inertia, body.gravcomp = 0.01, [1e-5] * 3, 1.0
        body.ipos = [INERTIA_OFFSET] * 3
        return
    objects = library.objects
    inertia = objects["inertia"][row].double().numpy()
    body.mass = float(objects["mass"][row])
    body.ipos = objects["com"][row].double().numpy() + INERTIA_OFFSET
    order = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    body.fullinertia = [inertia[i, j] for i, j in order]


def _add_grain(
    body: mujoco.MjsBody, name: str, pos: np.ndarray, bits: tuple[int, int]
) -> None:
    """Fill an unused place of the layout with a geom that nothing reaches."""
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[_GRAIN, 0, 0],
        pos=pos,
        contype=bits[0],
        conaffinity=bits[1],
    )


def add_supports(spec: mujoco.MjSpec, discs: Tensor, physics: PhysicsConfig) -> None:
    """Add the discs that objects rest on.

    Of each disc [x, y, z_top, radius, height] in m, world; NaN is unused, (S, 5).
    """
    # Objects meet the support (2 & 2); hands do only when the recipe says so.
    bits = (1, 3) if physics.hand_support_contact else (0, 2)
    for i, (x, y, top, radius, height) in enumerate(discs.tolist()):
        name = f"support{i}"
        if not np.isfinite(top):
            _add_grain(spec.worldbody, name, np.array([0, 0, -20.0 - i]), bits)
            continue
        geom = spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius, height / 2, 0],
            pos=[x, y, top - height / 2],
            rgba=[0.8, 0.8, 0.78, 1.0],
        )
        geom.contype, geom.conaffinity = bits
        geom.friction = _friction(physics.support_friction, physics)


def add_contact_sensors(
    spec: mujoco.MjSpec, hand: HandSpec, slot: int, suffix: str = ""
) -> None:
    """Add a sensor a link: net force and point of its contact with one object."""
    for link in hand.link_names:
        # Ordered object first: the sensor then reports the force ON the link.
        spec.add_sensor(
            name=f"contact_{link}{suffix}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=f"object{slot}",
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=link,
            intprm=[_SENSOR_DATA, _NET_FORCE, 1],
        )
