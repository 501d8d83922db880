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
from flashdex.envs.scene.parts import (
    add_contact_sensors,
    add_object,
    add_supports,
    pad_bvh,
    set_hand_friction,
    set_options,
)
from flashdex.hands.attach import add_hand
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

MAX_PADDING = 100_000  # bounding volumes; scenes of real collections differ by hundreds
PARKED = {"left": (-4.0, 0.0, 3.0), "right": (4.0, 0.0, 3.0)}  # m, idle hands


@dataclass(frozen=True)
class SceneLayout:
    """What every scene of a collection contains."""

    sides: tuple[keys.Side, ...]  # hands that any motion of the collection uses
    num_objects: int  # object slots
    # convex parts of each slot, the largest count in the collection
    num_parts: tuple[int, ...]
    num_supports: int  # support discs, the largest count in the collection

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
        sides: list[keys.Side] = [s for i, s in enumerate(keys.SIDES) if active[i]]
        return cls(tuple(sides), slots, parts, int(discs))


@dataclass(frozen=True)
class Scene:
    """A compiled scene and where its quantities live."""

    xml: str  # self-contained MJCF text; the model is compiled from exactly this text
    layout: SceneLayout  # the layout shared by the collection
    hands: dict[keys.Side, HandSpec]  # specs of both sides

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
        names = self.hands[side].joint_names
        return np.array([self.model.joint(n).qposadr[0] for n in names])

    def joint_dof(self, side: keys.Side) -> np.ndarray:
        """Addresses of one hand's joints in qvel, (J,)."""
        names = self.hands[side].joint_names
        return np.array([self.model.joint(n).dofadr[0] for n in names])

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
    library: MotionLibrary, hands: dict[keys.Side, HandSpec], physics: PhysicsConfig
) -> list[Scene]:
    """Build the scenes of all motions of a collection, of one layout."""
    layout = SceneLayout.of(library)
    specs = [
        _make_spec(library, m, hands, physics, layout)
        for m in range(library.num_motions)
    ]
    # Counted on the model of the XML text: its rounded vertices can have other hulls.
    nodes = [mujoco.MjModel.from_xml_string(_to_xml(s)).nbvh for s in specs]
    for spec, count in zip(specs, nodes, strict=True):
        pad_bvh(spec, max(nodes) - count)
    return [Scene(_to_xml(spec), layout, hands) for spec in specs]


def rebuild_scene(
    library: MotionLibrary,
    motion: int,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    layout: SceneLayout,
    *,
    nodes: int,
) -> Scene:
    """One scene of a collection anew, without the others.

    Args:
        library: selected motions, as for ``build_scenes``.
        motion: row.
        hands: specs by side.
        physics: settings.
        layout: of the whole collection.
        nodes: bounding volumes that the scene has, where it has that many; the largest
            scene of its collection says how many.
    """
    spec = _make_spec(library, motion, hands, physics, layout)
    own = mujoco.MjModel.from_xml_string(_to_xml(spec)).nbvh
    pad_bvh(spec, max(0, min(nodes - own, MAX_PADDING)))
    return Scene(_to_xml(spec), layout, hands)


def _to_xml(spec: mujoco.MjSpec) -> str:
    spec.compile()
    return spec.to_xml()


def make_hands_spec(
    sides: tuple[keys.Side, ...],
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
) -> mujoco.MjSpec:
    """Begin a scene: options and hands, with their gains and friction."""
    spec = mujoco.MjSpec()
    set_options(spec, physics)
    for side in sides:
        add_hand(spec, hands[side], gains=physics.gains, gravcomp=physics.gravcomp)
        set_hand_friction(spec, side, physics)
    return spec


def _make_spec(
    library: MotionLibrary,
    motion: int,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    layout: SceneLayout,
) -> mujoco.MjSpec:
    spec = make_hands_spec(layout.sides, hands, physics)
    rows = library.motions["object_index"][motion].tolist()
    for slot in range(layout.num_objects):
        add_object(spec, library, rows[slot], slot, layout.num_parts[slot], physics)
    if physics.support_disks:
        discs = library.motions["support_disks"][motion][: layout.num_supports]
        add_supports(spec, discs, physics)
    slots = library.motions["hand_object"][motion].tolist()
    for side in layout.sides:
        slot = max(0, slots[keys.SIDES.index(side)])
        if layout.num_objects:
            add_contact_sensors(spec, hands[side], slot)
    return spec


def parked_joint_pos(hand: HandSpec) -> np.ndarray:
    """Joint positions of a hand that takes no part in the motion, (J,)."""
    pos = np.zeros(len(hand.joint_names))
    lower, upper = np.asarray(hand.joint_range).T
    pos[6:] = np.clip(0.0, lower[6:], upper[6:])
    pos[:3] = PARKED[hand.side]
    return pos
