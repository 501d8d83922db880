"""A scene a little other than it was planned in: what a trajectory should survive."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np


@dataclass(frozen=True)
class Perturbation:
    """Sizes of the disturbances; they are part of the certificate's schema."""

    object_pos: float = 2e-3  # first position, uniform per axis, m
    object_rot: float = float(np.radians(2.0))  # about a random axis, uniform, rad
    mass: tuple[float, float] = (0.8, 1.2)  # factor of mass and inertia, uniform
    friction: tuple[float, float] = (0.8, 1.2)  # factor of all friction, uniform
    ctrl_noise: float = 5e-3  # normal, std as a share of the actuator's range
    # a slide's range counts at most as this much, m: a wrist that may travel metres
    # would else be shaken by centimetres; the same for hinges, rad
    ctrl_range_m: float = 0.4
    ctrl_range_rad: float = float(np.pi)


PERTURBATION = Perturbation()


def perturb_model(
    model: mujoco.MjModel,
    objects: np.ndarray,
    rng: np.random.Generator,
    sizes: Perturbation = PERTURBATION,
) -> mujoco.MjModel:
    """A copy of the model with other masses of its ``objects`` and another friction.

    Args:
        model: stays as it is.
        objects: body of each object.
        rng: is drawn from.
        sizes: of the disturbances.
    """
    model = copy.deepcopy(model)
    for body in objects:
        factor = rng.uniform(*sizes.mass)
        tree = model.body_rootid == model.body_rootid[body]
        model.body_mass[tree] *= factor
        model.body_inertia[tree] *= factor
    factor = rng.uniform(*sizes.friction)
    model.geom_friction[:] *= factor
    model.pair_friction[:] *= factor
    # inverse weights of the solver follow from the masses
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def perturb_objects(
    qpos: np.ndarray,
    addresses: np.ndarray,
    rng: np.random.Generator,
    sizes: Perturbation = PERTURBATION,
) -> np.ndarray:
    """Positions (nq,) with the objects at ``addresses`` shifted and turned a little."""
    qpos = np.array(qpos, dtype=np.float64)
    for adr in addresses:
        shift = rng.uniform(-sizes.object_pos, sizes.object_pos, size=3)
        axis = rng.normal(size=3)
        angle = rng.uniform(-sizes.object_rot, sizes.object_rot)
        _move(qpos, adr, shift, axis, angle)
    return qpos


def worst_case(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    objects: np.ndarray,
    addresses: np.ndarray,
    index: int,
    *,
    seed: int,
    sizes: Perturbation = PERTURBATION,
) -> tuple[mujoco.MjModel, np.ndarray]:
    """A corner of the disturbances: heavy, slippery, as far off as they go.

    Even and odd ones are off in opposite directions.

    Args:
        model: stays as it is.
        qpos: first positions, (nq,); stay as they are.
        objects: body of each object.
        addresses: of each object in qpos.
        index: of the corner.
        seed: of the directions.
        sizes: of the disturbances.
    """
    heavy = replace(
        sizes,
        mass=(sizes.mass[1], sizes.mass[1]),
        friction=(sizes.friction[0], sizes.friction[0]),
    )
    rng = np.random.default_rng([seed, index // 2])
    model = perturb_model(model, objects, rng, heavy)
    qpos = np.array(qpos, dtype=np.float64)
    sign = 1 - 2 * (index % 2)
    for adr in addresses:
        shift = sign * sizes.object_pos * rng.choice([-1.0, 1.0], size=3)
        _move(qpos, adr, shift, rng.normal(size=3), sign * sizes.object_rot)
    return model, qpos


def _move(
    qpos: np.ndarray, adr: int, shift: np.ndarray, axis: np.ndarray, angle: float
) -> None:
    """Shift (m) and turn (rad, about a world axis) the object at ``adr``, in place."""
    turn, quat = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), angle)
    mujoco.mju_mulQuat(quat, turn, qpos[adr + 3 : adr + 7])
    qpos[adr : adr + 3] += shift
    qpos[adr + 3 : adr + 7] = quat


def control_range(
    model: mujoco.MjModel, ctrl: np.ndarray, sizes: Perturbation = PERTURBATION
) -> np.ndarray:
    """Range of each actuator: its own, else its joint's, else the span of ctrl (T, nu).

    Returns:
        m or rad, at most the caps of ``sizes``, (nu,).
    """
    width = np.ptp(ctrl, axis=0)
    for i in range(model.nu):
        joint = int(model.actuator_trnid[i, 0])
        drives_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        if model.actuator_ctrllimited[i]:
            width[i] = np.ptp(model.actuator_ctrlrange[i])
        elif drives_joint and model.jnt_limited[joint]:
            width[i] = np.ptp(model.jnt_range[joint])
        if drives_joint:
            is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            cap = sizes.ctrl_range_m if is_slide else sizes.ctrl_range_rad
            width[i] = min(width[i], cap)
    return width
