"""The scenes of a collection as one brax system and what differs by motion.

MJX bakes meshes, and which geoms can touch, into the compiled step. So all motions run
one system: they must use the same objects in the same slots; only the supports differ,
as tables that each world indexes by its motion.

MJX 3.17 knows no contact between cylinders and boxes or meshes: each support disc is
replaced by the upright box that encloses it, with the same top. It knows no contact
sensor between bodies either: ``brax_step`` computes what the sensors report.

Only imported where brax is known to be installed.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from brax.base import System
from brax.io import mjcf
from jax import Array

from flashdex.envs.scene.scene import Scene

# Contacts kept of each kind (sliding only, with torsion), per hand and object slot. MJX
# solves for every possible contact, 171 of one hand and one box, of which few exist.
CONTACTS_PER_BODY = 16


@dataclass(frozen=True)
class BraxModel:
    """One system, and tables of what motions and bodies are in it."""

    # all hands, objects and supports; the supports are the first motion's
    system: System
    support_geoms: np.ndarray  # geom ids of the supports, (D,)
    support_pos: Array  # centres by motion, world, m, (M, D, 3)
    support_size: Array  # half sizes by motion, m, (M, D, 3)
    # index of the link that owns a geom, -1 for others, (S, G)
    link_of_geom: np.ndarray
    slot_of_geom: np.ndarray  # object slot of a geom, -1 for others, (G,)
    places: int  # contacts kept of each contact dimension
    object_body: np.ndarray  # body of each object slot, (O',)
    object_qpos: np.ndarray  # first column of each object in qpos, (O',)
    object_dof: np.ndarray  # first column of each object in qvel, (O',)


def build_model(scenes: list[Scene]) -> BraxModel:
    """Build the system of scenes that contain the same objects."""
    scene = scenes[0]
    places = CONTACTS_PER_BODY * (len(scene.layout.sides) + scene.layout.num_objects)
    model = _brax_scene(scene, places)
    if (model.nq, model.nv, model.nu) != _sizes(scene.model):
        raise AssertionError("the brax scene has another state than the MuJoCo scene")
    discs = [f"support{i}" for i in range(scene.layout.num_supports)]
    geoms = [g for g in discs if mujoco.mj_name2id(model, _GEOM, g) >= 0]
    boxes = np.array([_boxes(s.model, geoms) for s in scenes], dtype=np.float32)
    slots = range(scene.layout.num_objects)
    links, objects = _owners(scene)
    return BraxModel(
        system=_load(model),
        support_geoms=np.array([model.geom(g).id for g in geoms], dtype=int),
        support_pos=jnp.asarray(boxes[:, 0]),
        support_size=jnp.asarray(boxes[:, 1]),
        link_of_geom=links,
        slot_of_geom=objects,
        places=places,
        object_body=np.array([model.body(f"object{s}").id for s in slots], dtype=int),
        object_qpos=np.array([scene.object_qpos(s) for s in slots], dtype=int),
        object_dof=np.array([scene.object_dof(s) for s in slots], dtype=int),
    )


_GEOM = mujoco.mjtObj.mjOBJ_GEOM


def _sizes(model: mujoco.MjModel) -> tuple[int, int, int]:
    return model.nq, model.nv, model.nu


def _brax_scene(scene: Scene, places: int) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(scene.xml)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in spec.geoms:
        if geom.name.startswith("support"):
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = [1.0, 1.0, 1.0]  # each world has its own
    spec.add_numeric(name="max_contact_points", data=[places])
    return spec.compile()


def _load(model: mujoco.MjModel) -> System:
    with warnings.catch_warnings():
        # Says at every start that brax no longer maintains its pipelines.
        warnings.filterwarnings("ignore", message="Brax System")
        return mjcf.load_model(model)


def _boxes(model: mujoco.MjModel, geoms: list[str]) -> np.ndarray:
    """Centres and half sizes of the boxes around supports, (2, D, 3)."""
    rows = np.zeros((2, len(geoms), 3))
    for i, name in enumerate(geoms):
        geom = model.geom(name)
        radius, half_height = geom.size[0], geom.size[1]
        if geom.type[0] != mujoco.mjtGeom.mjGEOM_CYLINDER:  # an unused one: a grain
            half_height = radius
        rows[:, i] = geom.pos, (radius, radius, half_height)
    return rows


def _owners(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Link of each hand and object slot that own each geom, (S, G) and (G,)."""
    model, layout = scene.model, scene.layout
    links = np.full((len(layout.sides), model.ngeom), -1)
    objects = np.full(model.ngeom, -1)
    for side, name in enumerate(layout.sides):
        for row, link in enumerate(scene.hands[name].link_names):
            links[side, model.geom_bodyid == model.body(link).id] = row
    for slot in range(layout.num_objects):
        objects[model.geom_bodyid == model.body(f"object{slot}").id] = slot
    return links, objects
