"""One self-contained MuJoCo scene a motion: hands, objects, supports, contact sensors.

All scenes of a collection share one layout (same bodies, joints, geoms, sensors), so
that worlds with different motions can be stepped side by side: a hand that takes no
part is parked out of reach, an empty object slot holds a grain out of reach, and unused
convex parts are grains inside the first one. Meshes are written inline, so the XML text
alone rebuilds the very same model.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from flashdex import keys
from flashdex.hands.attach import add_hand
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.recipe import PhysicsConfig

# Bit masks of method section 5: hands meet hands and objects, objects meet objects.
HAND_BITS = (1, 1)
OBJECT_BITS = (2, 3)
PARKED = {"left": (-4.0, 0.0, 3.0), "right": (4.0, 0.0, 3.0)}  # m, idle hands
_GRAIN = 1e-3  # m, radius of a geom that fills an unused place
# m; with its mass centre off the origin a body is never "simple", so that all scenes
# have the same inertia structure
_OFFSET = 1e-5
_SENSOR_DATA = 2 | 16  # bits of mjSENS_CONTACT: net force and position
_NET_FORCE = 3  # reduction: one wrench at the force-weighted point, world axes


@dataclass(frozen=True)
class SceneLayout:
    """What every scene of a collection contains.

    Attributes:
        sides: hands that any motion of the collection uses.
        num_objects: object slots.
        num_parts: convex parts of each slot, the largest count in the collection.
        num_supports: support discs, the largest count in the collection.
    """

    sides: tuple[keys.Side, ...]
    num_objects: int
    num_parts: tuple[int, ...]
    num_supports: int

    @classmethod
    def of(cls, library: MotionLibrary) -> SceneLayout:
        """Return the smallest layout that fits all motions of ``library``."""
        motions = library.motions
        active = motions["hand_active"].bool().any(0).tolist()
        rows = motions["object_index"].long()
        used = (rows >= 0).any(0)
        slots = int(used.nonzero().max()) + 1 if used.any() else 0
        counts = {r: len(library.parts(r)) for r in rows.unique().tolist() if r >= 0}
        parts = tuple(
            max((counts[r] for r in rows[:, s].tolist() if r >= 0), default=1)
            for s in range(slots)
        )
        discs = (~motions["support_disks"].isnan().any(-1)).sum(-1).max()
        sides = tuple(s for s, on in zip(keys.SIDES, active, strict=True) if on)
        return cls(sides, slots, parts, int(discs))


@dataclass(frozen=True)
class Scene:
    """A compiled scene and where its quantities live.

    Attributes:
        xml: self-contained MJCF text; the model is compiled from exactly this text.
        layout: the layout shared by the collection.
        hands: specs of both sides.
    """

    xml: str
    layout: SceneLayout
    hands: dict[str, HandSpec]

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model."""
        return mujoco.MjModel.from_xml_string(self.xml)

    @cached_property
    def sha256(self) -> str:
        """Hash of the XML text."""
        return hashlib.sha256(self.xml.encode()).hexdigest()

    def joint_qpos(self, side: keys.Side) -> np.ndarray:
        """Addresses of one hand's joints in qpos, (J,)."""
        return np.array(
            [self.model.joint(n).qposadr[0] for n in self.hands[side].joint_names]
        )

    def joint_dof(self, side: keys.Side) -> np.ndarray:
        """Addresses of one hand's joints in qvel, (J,)."""
        return np.array(
            [self.model.joint(n).dofadr[0] for n in self.hands[side].joint_names]
        )

    def joint_actuator(self, side: keys.Side) -> np.ndarray:
        """Actuators of one hand in joint order, (J,)."""
        owner = {int(j): a for a, j in enumerate(self.model.actuator_trnid[:, 0])}
        names = self.hands[side].joint_names
        return np.array([owner[self.model.joint(n).id] for n in names])

    def object_qpos(self, slot: int) -> int:
        """Address of an object's free joint in qpos."""
        return int(self.model.joint(f"object{slot}").qposadr[0])

    def object_dof(self, slot: int) -> int:
        """Address of an object's free joint in qvel."""
        return int(self.model.joint(f"object{slot}").dofadr[0])

    def contact_sensor(self, side: keys.Side) -> np.ndarray:
        """Addresses of force and point of each link in sensordata, (L, 6)."""
        names = self.hands[side].link_names
        start = [self.model.sensor(f"contact_{n}").adr[0] for n in names]
        return np.array(start)[:, None] + np.arange(6)


def build_scenes(
    library: MotionLibrary, hands: dict[str, HandSpec], physics: PhysicsConfig
) -> list[Scene]:
    """Build the scenes of all motions of a collection, of one layout.

    Args:
        library: the prepared collection.
        hands: hand specs by side.
        physics: time step, solver, gains, friction.
    """
    layout = SceneLayout.of(library)
    specs = [
        _make_spec(library, m, hands, physics, layout)
        for m in range(library.num_motions)
    ]
    nodes = [spec.compile().nbvh for spec in specs]
    for spec, count in zip(specs, nodes, strict=True):
        _pad_bvh(spec, max(nodes) - count)
        spec.compile()
    return [Scene(spec.to_xml(), layout, hands) for spec in specs]


def _make_spec(
    library: MotionLibrary,
    motion: int,
    hands: dict[str, HandSpec],
    physics: PhysicsConfig,
    layout: SceneLayout,
) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    _set_options(spec, physics)
    for side in layout.sides:
        add_hand(spec, hands[side], gains=physics.gains, gravcomp=physics.gravcomp)
        _set_hand_friction(spec, side, physics.friction)
    rows = library.motions["object_index"][motion].tolist()
    for slot in range(layout.num_objects):
        _add_object(spec, library, rows[slot], slot, layout.num_parts[slot], physics)
    if physics.support_disks:
        _add_supports(spec, library.motions["support_disks"][motion], layout, physics)
    slots = library.motions["hand_object"][motion].tolist()
    for side in layout.sides:
        slot = max(0, slots[keys.SIDES.index(side)])
        if layout.num_objects:
            _add_contact_sensors(spec, hands[side], slot)
    return spec


def _pad_bvh(spec: mujoco.MjSpec, nodes: int) -> None:
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


def _set_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    option = spec.option
    option.timestep = physics.timestep
    option.iterations = physics.iterations
    option.ls_iterations = physics.ls_iterations
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = physics.impratio
    # A world that diverges is ended and counted; a silent reset would hide it.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.degree = False


def _set_hand_friction(spec: mujoco.MjSpec, side: keys.Side, friction: float) -> None:
    for geom in spec.geoms:
        if geom.parent.name.startswith(f"{side}_"):
            geom.contype, geom.conaffinity = HAND_BITS
            geom.friction[0] = friction


def _add_object(
    spec: mujoco.MjSpec,
    library: MotionLibrary,
    row: int,
    slot: int,
    num_parts: int,
    physics: PhysicsConfig,
) -> None:
    body = spec.worldbody.add_body(name=f"object{slot}")
    body.add_freejoint(name=f"object{slot}")
    parts = library.parts(row) if row >= 0 else []
    body.explicitinertial = True
    if row >= 0:
        objects = library.objects
        inertia = objects["inertia"][row].double().numpy()
        body.mass = float(objects["mass"][row])
        body.ipos = objects["com"][row].double().numpy() + _OFFSET
        order = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
        body.fullinertia = [inertia[i, j] for i, j in order]
    else:
        body.mass, body.inertia, body.gravcomp = 0.01, [1e-5] * 3, 1.0
        body.ipos = [_OFFSET] * 3
    inside = parts[0].mean(0) if parts else np.zeros(3)
    for i in range(num_parts):
        name = f"object{slot}_part{i}"
        if i < len(parts):
            mesh = spec.add_mesh(name=name)
            mesh.uservert = np.asarray(parts[i], np.float64).reshape(-1)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            geom = body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name
            )
            geom.contype, geom.conaffinity = OBJECT_BITS
            geom.friction = [physics.object_friction, 0.05, 0.05]
            geom.condim = physics.condim
            geom.rgba = [0.85, 0.55, 0.25, 1.0] if slot == 0 else [0.3, 0.6, 0.4, 1.0]
        else:
            _add_grain(body, name, inside, OBJECT_BITS)


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


def _add_supports(
    spec: mujoco.MjSpec, discs: object, layout: SceneLayout, physics: PhysicsConfig
) -> None:
    # Objects meet the support (2 & 2); hands do only when the recipe says so.
    bits = (1, 3) if physics.hand_support_contact else (0, 2)
    for i in range(layout.num_supports):
        x, y, top, radius, height = (float(v) for v in discs[i])  # type: ignore[index]
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
        geom.friction = [physics.support_friction, 0.05, 0.05]


def _add_contact_sensors(spec: mujoco.MjSpec, hand: HandSpec, slot: int) -> None:
    for link in hand.link_names:
        # Ordered object first: the sensor then reports the force ON the link.
        spec.add_sensor(
            name=f"contact_{link}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=f"object{slot}",
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=link,
            intprm=[_SENSOR_DATA, _NET_FORCE, 1],
        )


def parked_joint_pos(hand: HandSpec) -> np.ndarray:
    """Joint positions of a hand that takes no part in the motion, (J,)."""
    pos = np.zeros(len(hand.joint_names))
    lower, upper = np.asarray(hand.joint_range).T
    pos[6:] = np.clip(0.0, lower[6:], upper[6:])
    pos[:3] = PARKED[hand.side]
    return pos
