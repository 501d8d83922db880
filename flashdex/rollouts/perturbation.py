"""Small seeded disturbances of a stored rollout: what a robust conversion survives."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from flashdex.rollouts.resimulation import Scene
from flashdex.rollouts.rollout import Rollout


@dataclass(frozen=True)
class Perturbation:
    """Sizes; they are part of the certificate's schema.

    Args:
        object_pos: first object position, uniform per axis, m.
        object_rot: first object turn about a random axis, uniform, rad.
        mass: object mass and inertia factor, uniform.
        friction: factor of all friction, uniform.
        ctrl_noise: standard deviation of normal noise, share of the actuator's range.
        ctrl_range_m: a slide's range counts at most as this much, m: a wrist that may
            travel metres would else be shaken by centimetres.
        ctrl_range_rad: the same for hinges, rad.
    """

    object_pos: float = 2e-3
    object_rot: float = float(np.radians(2.0))
    mass: tuple[float, float] = (0.8, 1.2)
    friction: tuple[float, float] = (0.8, 1.2)
    ctrl_noise: float = 5e-3
    ctrl_range_m: float = 0.4
    ctrl_range_rad: float = float(np.pi)


def control_range(
    model: mujoco.MjModel, ctrl: np.ndarray, settings: Perturbation
) -> np.ndarray:
    """Range of each actuator: its own, else its joint's, else the span it was used in.

    Args:
        model: compiled model.
        ctrl: controls of the rollout, (T, nu).
        settings: caps.

    Returns:
        m or rad, (nu,).
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
            cap = settings.ctrl_range_m if is_slide else settings.ctrl_range_rad
            width[i] = min(width[i], cap)
    return width


def perturb_model(
    scene: Scene, rng: np.random.Generator, settings: Perturbation
) -> Scene:
    """A copy of the scene with other object masses and another friction.

    Args:
        scene: nominal scene.
        rng: random source.
        settings: sizes.
    """
    model = copy.deepcopy(scene.model)
    for body in scene.object_body[scene.object_body >= 0]:
        factor = rng.uniform(*settings.mass)
        tree = model.body_rootid == model.body_rootid[body]
        model.body_mass[tree] *= factor
        model.body_inertia[tree] *= factor
    factor = rng.uniform(*settings.friction)
    model.geom_friction[:] *= factor
    model.pair_friction[:] *= factor
    # inverse weights of the solver follow from the masses
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(scene, model=model)


def perturb_state(
    scene: Scene, qpos0: np.ndarray, rng: np.random.Generator, settings: Perturbation
) -> np.ndarray:
    """First positions with every object shifted and turned a little.

    Args:
        scene: addresses of the objects.
        qpos0: (nq,).
        rng: random source.
        settings: sizes.

    Returns:
        (nq,).
    """
    qpos = np.array(qpos0, dtype=np.float64)
    for adr in scene.object_adr[scene.object_adr >= 0]:
        shift = rng.uniform(-settings.object_pos, settings.object_pos, size=3)
        axis = rng.normal(size=3)
        angle = rng.uniform(-settings.object_rot, settings.object_rot)
        turn, quat = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), angle)
        mujoco.mju_mulQuat(quat, turn, qpos[adr + 3 : adr + 7])
        qpos[adr : adr + 3] += shift
        qpos[adr + 3 : adr + 7] = quat
    return qpos


def perturb(
    scene: Scene,
    rollout: Rollout,
    *,
    seed: int,
    index: int,
    settings: Perturbation | None = None,
) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Scene, first positions and controls of one perturbed run.

    Args:
        scene: nominal scene.
        rollout: first state and controls.
        seed: seed of the certificate.
        index: number of the run.
        settings: sizes.

    Returns:
        Scene, qpos0 (nq,), ctrl (T, nu).
    """
    settings = settings or Perturbation()
    rng = np.random.default_rng([seed, index])
    changed = perturb_model(scene, rng, settings)
    qpos0 = perturb_state(scene, rollout.qpos0, rng, settings)
    width = control_range(scene.model, rollout.ctrl, settings)
    noise = rng.normal(size=rollout.ctrl.shape) * settings.ctrl_noise * width
    return changed, qpos0, rollout.ctrl + noise
