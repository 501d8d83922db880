"""One model that can become the scene of any motion, for engines with a single model.

It has the layout of the collection's scenes and the convex parts of all objects as mesh
assets. What differs between motions are rows of numbers, read off the compiled scenes:
``SceneUnion.rows`` holds one a motion. A part or support that a motion lacks is absent
(mesh id -1) or out of reach.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from flashdex import keys
from flashdex.envs.scene.parts import (
    add_contact_sensors,
    add_object_of_meshes,
    add_part_mesh,
    add_supports,
)
from flashdex.envs.scene.scene import Scene, SceneLayout, make_hands_spec
from flashdex.errors import FlashdexError
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

# Arrays of the model that differ by design: assets, and one set of sensors a slot.
_OWN = ("mesh_", "sensor_")


@dataclass(frozen=True)
class SceneUnion:
    """The union of all scenes of a collection."""

    # compiled union; fields equal in all motions hold their value
    model: mujoco.MjModel
    rows: dict[str, np.ndarray]  # fields that differ between motions, by name, (M, ...)
    # addresses in sensordata of force and point of each link against the own object of
    # each hand, (M, S, L, 6)
    contact: np.ndarray


def build_union(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    scenes: list[Scene],
    fields: Iterable[str],
) -> SceneUnion:
    """Build the union of the scenes of a collection.

    Raises:
        FlashdexError: a convex part has another shape in the union than in a scene.
    """
    layout = scenes[0].layout
    spec = _union_spec(library, hands, physics, layout)
    spec.compile()
    # From text as the scenes are, so that vertices are rounded alike.
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    motions, rows = range(len(scenes)), {}
    mesh_ids = np.stack([_mesh_ids(library, m, scenes, model) for m in motions])
    unused = np.stack([_unused(s.model, model) for s in scenes])
    for name in fields:
        own = getattr(model, name, None)
        if not isinstance(own, np.ndarray) or name.startswith(_OWN) or own.size == 0:
            continue
        values = np.stack([np.array(getattr(s.model, name)) for s in scenes])
        if name == "geom_dataid":
            values = mesh_ids
        elif name.startswith("geom_"):
            values[unused] = np.broadcast_to(own, values.shape)[unused]
        if (values != values[0]).any() or (name == "geom_dataid" and unused.any()):
            rows[name] = values
        else:
            own[:] = values[0]
    return SceneUnion(model, rows, _contact(library, hands, layout, model))


def _union_spec(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    layout: SceneLayout,
) -> mujoco.MjSpec:
    spec = make_hands_spec(layout.sides, hands, physics)
    names = []
    for row in sorted(set(library.motions["object_index"].flatten().tolist()) - {-1}):
        for i, part in enumerate(library.parts(row)):
            names.append(_asset(row, i))
            add_part_mesh(spec, names[-1], np.asarray(part))
    for slot in range(layout.num_objects):
        # Any part will do: each world's own are written over it.
        add_object_of_meshes(spec, names[:1] * layout.num_parts[slot], slot, physics)
    if physics.support_disks:
        low = -20.0 - torch.arange(layout.num_supports)
        size = torch.tensor([1e-3, 2e-3]).expand(len(low), 2)
        flat = torch.zeros(len(low), 2)
        add_supports(spec, torch.cat([flat, low[:, None], size], -1), physics)
    for side in layout.sides:
        for slot in range(layout.num_objects):
            add_contact_sensors(spec, hands[side], slot, suffix=f"_object{slot}")
    return spec


def _asset(row: int, part: int) -> str:
    return f"row{row}_part{part}"


def _unused(scene: mujoco.MjModel, union: mujoco.MjModel) -> np.ndarray:
    """Geoms that only fill a place in this scene, (G,): the union's have the type."""
    return scene.geom_type != union.geom_type


def _mesh_ids(
    library: MotionLibrary, motion: int, scenes: list[Scene], union: mujoco.MjModel
) -> np.ndarray:
    """Mesh of the union for each geom of one motion, -1 is none, (G,)."""
    scene = scenes[motion].model
    objects = library.motions["object_index"][motion].tolist()
    out = np.full(scene.ngeom, -1, dtype=np.int32)
    for geom in np.flatnonzero(scene.geom_dataid >= 0):
        name = scene.mesh(scene.geom_dataid[geom]).name
        slot, _, part = name.removeprefix("object").partition("_part")
        if name.startswith("object"):
            name = _asset(objects[int(slot)], int(part))
        out[geom] = union.mesh(name).id
        _check_shape(scene, int(scene.geom_dataid[geom]), union, int(out[geom]))
    return out


def _check_shape(
    scene: mujoco.MjModel, mesh: int, union: mujoco.MjModel, other: int
) -> None:
    def vertices(model: mujoco.MjModel, index: int) -> np.ndarray:
        start, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
        return model.mesh_vert[start : start + count]

    same = np.array_equal(vertices(scene, mesh), vertices(union, other))
    if not same or union.mesh_graphadr[other] < 0:
        raise FlashdexError(
            f"convex part '{union.mesh(other).name}': its shape in the model of all "
            "motions is not that of its own scene, so their physics would differ. "
            "Use physics.engine=cpu, and report this part."
        )


def _contact(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    layout: SceneLayout,
    union: mujoco.MjModel,
) -> np.ndarray:
    links = max(len(h.link_names) for h in hands.values())
    own = library.motions["hand_object"].clamp_min(0).numpy()
    out = np.zeros((len(own), len(layout.sides), links, 6), dtype=np.int64)
    if layout.num_objects == 0:
        return out
    for i, side in enumerate(layout.sides):
        names = hands[side].link_names
        start = [
            [union.sensor(f"contact_{n}_object{s}").adr[0] for n in names]
            for s in range(layout.num_objects)
        ]
        slots = own[:, keys.SIDES.index(side)]
        out[:, i] = np.array(start)[slots][..., None] + np.arange(6)
    return out
