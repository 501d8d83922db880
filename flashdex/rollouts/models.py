"""Is a stored model the scene of its motion? Element by element against one built anew.

With the library at hand the whole scene is built from it. Without, the shapes, masses
and supports are taken from the stored model, and everything else is built around them:
what is not a hand, an object or a support of ours then shows as a difference.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import mujoco
import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from flashdex import keys
from flashdex.envs.scene.parts import INERTIA_OFFSET
from flashdex.envs.scene.scene import SceneLayout, rebuild_scene
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary
from flashdex.objects.bodies import DENSITY, MASS, MAX_SIZE

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

# Of a scene built around numbers that went through a text and a diagonalisation.
RTOL, ATOL = 1e-4, 1e-8
# Follow from meshes and poses alone; the order of their nodes is rounding's.
_DERIVED = ("bvh_", "oct_", "mesh_octadr", "mesh_octnum")
# A round body has its axes from rounding: its inertia is compared in the body's frame,
# and flags of equal frames follow from what is compared.
_OF_AXES = ("body_iquat", "body_inertia")
_OF_FRAMES = "_sameframe"
MAX_FRICTION = 5.0


def compare_models(
    stored: mujoco.MjModel, expected: mujoco.MjModel, *, exact: bool
) -> dict[str, str]:
    """Fields of a compiled model that are not what they should be, with words for each.

    ``exact``: to the rounding of a text; else to that of a diagonalisation, too.
    """
    rtol, atol = (1e-9, 1e-12) if exact else (RTOL, ATOL)
    found: dict[str, str] = {}
    _compare_names(stored, expected, found)
    if not exact:
        inertias = [_full_inertias(model) for model in (stored, expected)]
        if inertias[0].shape == inertias[1].shape:
            size = np.trace(inertias[1], axis1=1, axis2=2)[:, None, None]
            if (np.abs(inertias[0] - inertias[1]) > rtol * size).any():
                found["body_inertia"] = _where(*inertias)
    for name, value, other in _fields(stored, expected):
        if name.startswith(_DERIVED) or (
            not exact and (name in _OF_AXES or name.endswith(_OF_FRAMES))
        ):
            continue
        a, b = np.asarray(value), np.asarray(other)
        if a.shape != b.shape:
            found[name] = f"has shape {a.shape}, expected {b.shape}"
        elif a.dtype.kind not in "fc" and b.dtype.kind not in "fc":
            if (a != b).any():  # a bit of a flag is a small share of it
                found[name] = _where(a, b)
        elif not np.allclose(a, b, rtol=rtol, atol=atol, equal_nan=True):
            found[name] = _where(a, b)
    return found


def _compare_names(
    stored: mujoco.MjModel, expected: mujoco.MjModel, found: dict[str, str]
) -> None:
    for kind in ("body", "jnt", "geom", "site", "actuator", "eq", "tendon", "sensor"):
        names, wanted = (_names(m, kind) for m in (stored, expected))
        if names != wanted:
            more = sorted(set(names) - set(wanted))[:3]
            less = sorted(set(wanted) - set(names))[:3]
            found[f"{kind} elements"] = (
                f"{len(names)} instead of {len(wanted)}; too many: {more}, "
                f"missing: {less}"
            )


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"jnt": "njnt", "eq": "neq"}.get(kind, f"n{kind}")
    start = getattr(model, f"name_{kind}adr")
    return [
        model.names[adr : model.names.index(b"\0", adr)].decode(errors="replace")
        for adr in start[: getattr(model, count)]
    ]


def _fields(
    stored: mujoco.MjModel, expected: mujoco.MjModel
) -> list[tuple[str, Any, Any]]:
    out = []
    for prefix, a, b in (
        ("", stored, expected),
        ("option ", stored.opt, expected.opt),
        # its mean inertia scales the tolerance of the solver
        ("statistic ", stored.stat, expected.stat),
    ):
        for name in dir(b):
            other = None if name.startswith("_") else getattr(b, name, None)
            if isinstance(other, (np.ndarray, int, float)):
                out.append((prefix + name, getattr(a, name), other))
    return out


def _where(stored: np.ndarray, expected: np.ndarray) -> str:
    difference = np.abs(stored.astype(float) - expected.astype(float))
    difference = np.where(np.isnan(difference), np.inf, difference)
    at = np.unravel_index(int(difference.argmax()), difference.shape)
    place = f" at {tuple(int(i) for i in at)}" if at else ""
    return f"is {stored[at]:.6g}{place}, expected {expected[at]:.6g}"


@dataclass
class _Found:
    """What a stored model says of objects and supports, in the form of a library."""

    parts: dict[int, list[np.ndarray]] = field(default_factory=dict)
    rows: list[int] = field(default_factory=list)  # slot -> object row, -1 empty
    num_parts: list[int] = field(default_factory=list)
    mass: list[float] = field(default_factory=list)
    com: list[np.ndarray] = field(default_factory=list)
    inertia: list[np.ndarray] = field(default_factory=list)
    supports: list[list[float]] = field(default_factory=list)


def rebuild_around(
    xml: str,
    model: mujoco.MjModel,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    hand_object: list[int],
) -> mujoco.MjModel:
    """The scene of ours with the objects and supports of a stored model.

    Args:
        xml: checked text of the stored model.
        model: compiled from it.
        hands: specs by side.
        physics: settings that the scene is said to be built by.
        hand_object: object slot of each hand, -1 without.

    Raises:
        ValueError: there is nothing in it that a scene of ours could be built around.
    """
    found = _read(mujoco.MjSpec.from_string(xml), model)
    sides: list[keys.Side] = [
        side
        for side in keys.SIDES
        if mujoco.mj_name2id(
            model, mujoco.mjtObj.mjOBJ_JOINT, hands[side].joint_names[0]
        )
        >= 0
    ]
    if not sides:
        raise ValueError("it holds no hand of that name")
    discs = np.full((max(1, len(found.supports)), 5), np.nan)
    for row, disc in enumerate(found.supports):
        discs[row] = disc
    empty = np.zeros((0, 3, 3)), np.zeros((0, 3))
    inertia = np.array(found.inertia) if found.inertia else empty[0]
    com = np.array(found.com) if found.com else empty[1]
    library = SimpleNamespace(
        parts=found.parts.__getitem__,
        objects={
            "mass": torch.tensor(found.mass, dtype=torch.float64),
            "com": torch.from_numpy(com),
            "inertia": torch.from_numpy(inertia),
        },
        motions={
            "object_index": torch.tensor([found.rows or [-1]]),
            "support_disks": torch.from_numpy(discs)[None],
            "hand_object": torch.tensor([hand_object]),
        },
    )
    layout = SceneLayout(
        tuple(sides), len(found.rows), tuple(found.num_parts), len(found.supports)
    )
    stand_in = cast(MotionLibrary, library)
    scene = rebuild_scene(stand_in, 0, hands, physics, layout, nodes=model.nbvh)
    return scene.model


def _read(spec: mujoco.MjSpec, model: mujoco.MjModel) -> _Found:
    found = _Found()
    meshes = {mesh.name: np.array(mesh.uservert).reshape(-1, 3) for mesh in spec.meshes}
    geoms = {geom.name: geom for geom in spec.geoms}
    slot = 0
    while (body := _id(model, "BODY", f"object{slot}")) >= 0:
        names = [n for n in geoms if n.startswith(f"object{slot}_part")]
        parts = [
            meshes[geoms[n].meshname]
            for n in names
            if geoms[n].type == mujoco.mjtGeom.mjGEOM_MESH
            and geoms[n].meshname in meshes
        ]
        row = len(found.mass) if parts else -1
        found.rows.append(row)
        found.num_parts.append(max(1, len(names)))
        if parts:
            found.parts[row] = parts
            found.mass.append(float(model.body_mass[body]))
            found.com.append(model.body_ipos[body] - INERTIA_OFFSET)
            found.inertia.append(_full_inertias(model)[body])
        slot += 1
    while (geom := _id(model, "GEOM", f"support{len(found.supports)}")) >= 0:
        radius, half, _ = model.geom_size[geom]
        x, y, z = model.geom_pos[geom]
        is_disc = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER
        disc = [x, y, z + half, radius, 2 * half] if is_disc else [np.nan] * 5
        found.supports.append([float(v) for v in disc])
    return found


def _id(model: mujoco.MjModel, kind: str, name: str) -> int:
    return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), name)


def _full_inertias(model: mujoco.MjModel) -> np.ndarray:
    """Inertia of every body about its mass centre, axes of the body, (nbody, 3, 3)."""
    turns = np.empty((model.nbody, 9))
    for turn, quat in zip(turns, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(turn, quat)
    axes = turns.reshape(-1, 3, 3)
    return (axes * model.body_inertia[:, None, :]) @ axes.transpose(0, 2, 1)


def implausible(model: mujoco.MjModel, object_body: np.ndarray) -> dict[str, str]:
    """Numbers of objects and supports that no library of ours would hold.

    ``object_body`` is the body of each slot, -1 when empty, (O,).
    """
    found: dict[str, str] = {}
    for body in object_body[object_body >= 0].tolist():
        name = model.body(body).name
        own = np.flatnonzero(model.geom_bodyid == body)
        own = own[model.geom_type[own] == mujoco.mjtGeom.mjGEOM_MESH]
        mass = float(model.body_mass[body])
        mesh = model.geom_dataid[own]
        volume = sum(_hull_volume(model, int(m)) for m in mesh)
        size = float(model.geom_rbound[own].max(initial=0.0))
        density = mass / volume if volume > 0 else np.inf
        if not len(own):
            continue  # no object of ours; the comparison says so
        if not MASS[0] <= mass <= MASS[1]:
            found[f"{name} mass"] = f"is {mass:.3g} kg"
        elif not DENSITY[0] <= density <= DENSITY[1]:
            found[f"{name} mass"] = f"is {mass:.3g} kg, that is {density:.3g} kg/m3"
        moments = model.body_inertia[body]
        # of no body within that radius around its mass centre
        reach = 2 * size + float(np.linalg.norm(model.body_ipos[body]))
        if not (moments > 0).all() or moments.max() > 2 * mass * reach**2:
            found[f"{name} inertia"] = f"is {moments.tolist()} kg m2"
        if size > MAX_SIZE:
            found[f"{name} size"] = f"is {size:.3g} m"
    highest = float(model.geom_friction[:, 0].max(initial=0.0))
    if highest > MAX_FRICTION:
        found["friction"] = f"is {highest:.3g}, at most {MAX_FRICTION:g} is plausible"
    return found


def _hull_volume(model: mujoco.MjModel, mesh: int) -> float:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    try:
        return float(ConvexHull(model.mesh_vert[start : start + count]).volume)
    except (QhullError, ValueError):
        return 0.0
