"""Open-loop replay of stored controls in MuJoCo C, as stored or a little disturbed.

No wrench, no feedback, no reset: the first state, the control rows, and the model of
the file. Fingertips and links are recomputed from the model's sites and bodies.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from flashdex.envs.scene.perturbation import (
    PERTURBATION,
    Perturbation,
    control_range,
    perturb_model,
    perturb_objects,
)
from flashdex.errors import RunError
from flashdex.keys import FINGERS, SIDES
from flashdex.metrics.criteria import score
from flashdex.metrics.criteria_table import Verdict
from flashdex.metrics.errors import TrackingErrors
from flashdex.rollouts.rollout import Rollout
from flashdex.system.mjcf import compile_mjcf

# a proof may cost more than training: solver effort of at least these (method, sec. 17)
MIN_ITERATIONS, MIN_LS_ITERATIONS = 100, 200
# MuJoCo goes on after these, with contacts dropped or controls set to zero
NUMERIC_WARNINGS = tuple(
    f"mjWARN_{what}"
    for what in ("CONTACTFULL", "CNSTRFULL", "BADCTRL", "BADQPOS", "BADQVEL", "BADQACC")
)

StepMonitor = Callable[[mujoco.MjModel, mujoco.MjData], None]


@dataclass(frozen=True)
class Simulation:
    """What a rollout is replayed with, and where its parts are in the model (or -1)."""

    rollout: Rollout  # reference, first velocities, masks
    model: mujoco.MjModel
    qpos0: np.ndarray  # first positions, (nq,)
    ctrl: np.ndarray  # position targets, (T, nu)
    object_body: np.ndarray  # body of each object slot, (O,)
    object_adr: np.ndarray  # qpos address of each object slot, (O,)
    pad_sites: np.ndarray  # fingertip sites, (2, 5)
    joint_bodies: np.ndarray  # bodies of ``joints``, (2, M)
    wrist_bodies: np.ndarray  # (2,)


@dataclass(frozen=True)
class Replay:
    """States and counts of one open-loop replay; world, m, rad, wxyz."""

    qpos: np.ndarray  # after each control step, (T, nq)
    errors: TrackingErrors  # against the rollout's reference
    verdicts: dict[str, Verdict]  # of every criterion
    warnings: dict[str, int]  # MuJoCo warning -> times raised
    nan_count: int  # values of the states that are not finite
    wrench_max: float  # largest applied force or torque seen, N or N m


def load_simulation(
    rollout: Rollout, given: mujoco.MjModel | None = None
) -> Simulation:
    """Find the parts of a rollout in its model, which is compiled where None is given.

    Raises:
        FlashdexError: the model is not allowed or does not compile, or a part is not
            in it.
    """
    motion = rollout.motion
    own = given or compile_mjcf(rollout.model_xml, where=motion)
    model: mujoco.MjModel = copy.deepcopy(own)
    model.opt.iterations = max(model.opt.iterations, MIN_ITERATIONS)
    model.opt.ls_iterations = max(model.opt.ls_iterations, MIN_LS_ITERATIONS)
    # a diverged state must stay visible instead of being reset
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _check_sizes(model, rollout)
    adr = np.asarray(rollout.object_qpos_adr, dtype=np.int64)
    wrists = json.loads(rollout.wrist_bodies or "[null, null]")
    if len(wrists) != 2 or not all(w is None or isinstance(w, str) for w in wrists):
        raise RunError(f"{motion}: wrist_bodies must hold two names, or null.")
    active = rollout.hand_active.astype(bool)
    named = [n if on else None for n, on in zip(wrists, active, strict=True)]
    return Simulation(
        rollout=rollout,
        model=model,
        qpos0=rollout.qpos0,
        ctrl=rollout.ctrl,
        object_body=np.array([_free_body(model, a, motion) for a in adr]),
        object_adr=adr,
        pad_sites=np.array([[_site(model, s, f) for f in FINGERS] for s in SIDES]),
        joint_bodies=_joint_bodies(model, rollout),
        wrist_bodies=np.array([_body(model, n, motion) for n in named]),
    )


def _joint_bodies(model: mujoco.MjModel, rollout: Rollout) -> np.ndarray:
    links = json.loads(rollout.joint_bodies)
    count = rollout.joints.shape[2]
    if len(links) != 2 or not all(
        isinstance(side, list)
        and len(side) in (0, count)
        and all(isinstance(name, str) for name in side)
        for side in links
    ):
        raise RunError(
            f"{rollout.motion}: joint_bodies must hold two lists (left, right) of "
            f"{count} body names, one a row of joints, or empty lists."
        )
    bodies = np.full((2, count), -1)
    # the model of a one-handed motion need not contain the other hand
    for hand in np.flatnonzero(rollout.hand_active):
        if links[hand]:
            bodies[hand] = [_body(model, n, rollout.motion) for n in links[hand]]
    return bodies


def _check_sizes(model: mujoco.MjModel, rollout: Rollout) -> None:
    for key, size in (("qpos0", model.nq), ("qvel0", model.nv), ("ctrl", model.nu)):
        columns = getattr(rollout, key).shape[-1]
        if columns != size:
            raise RunError(
                f"{rollout.motion}: {key} has {columns} columns, the model needs "
                f"{size}. Model and states are not of the same scene."
            )


def _free_body(model: mujoco.MjModel, adr: int, motion: str) -> int:
    if adr < 0:
        return -1
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    joint = np.flatnonzero(free & (model.jnt_qposadr == adr))
    if not len(joint):
        raise RunError(
            f"{motion}: object_qpos_adr {adr} is no free joint of the model. Allowed: "
            f"{model.jnt_qposadr[free].tolist()} or -1."
        )
    return int(model.jnt_bodyid[joint[0]])


def _site(model: mujoco.MjModel, side: str, finger: str) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, f"{side}_pad_{finger}")


def _body(model: mujoco.MjModel, name: str | None, motion: str) -> int:
    if not name:
        return -1
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if index < 0:
        raise RunError(f"{motion}: body '{name}' is not in model_xml.")
    return index


def model_hash(model: mujoco.MjModel) -> str:
    """SHA-256 of the compiled model."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def resimulate(sim: Simulation, *, monitor: StepMonitor | None = None) -> Replay:
    """Apply the controls open loop from the first state; monitor every substep."""
    data, states = _step(sim.model, sim.rollout, sim.qpos0, sim.ctrl, monitor=monitor)
    qpos = states["qpos"]
    nan_count = sum(int((~np.isfinite(rows)).sum()) for rows in states.values())
    # nobody applies one: what a step leaves there came with the model
    wrench_max = max(np.abs(data.xfrc_applied).max(), np.abs(data.qfrc_applied).max())
    warnings = {
        name: int(data.warning[kind].number)
        for name, kind in mujoco.mjtWarning.__members__.items()
        if name.startswith("mjWARN_")
    }
    overflow = any(warnings[name] for name in NUMERIC_WARNINGS) or nan_count > 0
    points = {**tracked_points(sim, qpos), **object_poses(sim, qpos)}
    errors = sim.rollout.errors_of(points, overflow=overflow)
    verdicts = score(errors, grace=sim.rollout.grace)
    return Replay(qpos, errors, verdicts, warnings, nan_count, float(wrench_max))


def tracked_points(sim: Simulation, qpos: np.ndarray) -> dict[str, np.ndarray | None]:
    """Fingertips, links and wrists by forward kinematics, (T, 2, ..., 3)."""
    data = mujoco.MjData(sim.model)
    parts = {
        "fingertips": (data.site_xpos, sim.pad_sites),
        "joints": (data.xpos, sim.joint_bodies),
        "wrist_pos": (data.xpos, sim.wrist_bodies),
    }
    points = {
        key: np.empty((len(qpos), *index.shape, 3)) for key, (_, index) in parts.items()
    }
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(sim.model, data)
        for key, (xpos, index) in parts.items():
            points[key][t] = xpos[index]
    active = np.flatnonzero(sim.rollout.hand_active)
    found: dict[str, np.ndarray | None] = {}
    for key, (_, index) in parts.items():
        points[key][:, index < 0] = np.nan
        # a part that the model lacks is a hole of the file, not a failure
        found[key] = None if (index[active] < 0).any() else points[key]
    return found


def object_poses(sim: Simulation, qpos: np.ndarray) -> dict[str, np.ndarray | None]:
    """Poses of the objects in flat states, (T, O, 3) and (T, O, 4), NaN where none."""
    pose = np.full((len(qpos), len(sim.object_adr), 7), np.nan)
    for slot, adr in enumerate(sim.object_adr):
        if adr >= 0:
            pose[:, slot] = qpos[:, adr : adr + 7]
    return {"object_pos": pose[..., :3], "object_quat": pose[..., 3:]}


def perturb(
    sim: Simulation, sizes: Perturbation = PERTURBATION, *, seed: int, index: int
) -> Simulation:
    """The same rollout, a little disturbed: what a robust conversion survives.

    ``seed`` is the certificate's, ``index`` the number of the perturbed replay.
    """
    rng = np.random.default_rng([seed, index])
    there = sim.object_adr >= 0
    model = perturb_model(sim.model, sim.object_body[there], rng, sizes)
    qpos0 = perturb_objects(sim.qpos0, sim.object_adr[there], rng, sizes)
    width = control_range(sim.model, sim.ctrl, sizes)
    noise = rng.normal(size=sim.ctrl.shape) * sizes.ctrl_noise * width
    return replace(sim, model=model, qpos0=qpos0, ctrl=sim.ctrl + noise)


def simulate(
    model: mujoco.MjModel, rollout: Rollout, *, single: bool = False
) -> dict[str, np.ndarray]:
    """States of the controls in MuJoCo C with the settings of the model, nothing more.

    Args:
        model: as stored, or built anew.
        rollout: first state and controls.
        single: begin every control step from the stored state before it.

    Returns:
        ``qpos`` (T, nq) and ``qvel`` (T, nv).
    """
    return _step(model, rollout, rollout.qpos0, rollout.ctrl, single=single)[1]


def _step(
    model: mujoco.MjModel,
    rollout: Rollout,
    qpos0: np.ndarray,
    ctrl: np.ndarray,
    *,
    single: bool = False,
    monitor: StepMonitor | None = None,
) -> tuple[mujoco.MjData, dict[str, np.ndarray]]:
    """The last state, and positions and velocities after each control step."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos0, rollout.qvel0
    if rollout.act0 is not None and model.na:
        data.act[:] = rollout.act0
    steps = len(ctrl)
    out = {"qpos": np.empty((steps, model.nq)), "qvel": np.empty((steps, model.nv))}
    for t, row in enumerate(ctrl):
        if single and t:
            data.qpos[:], data.qvel[:] = rollout.qpos[t - 1], rollout.qvel[t - 1]
        data.ctrl[:] = row
        for _ in range(rollout.decimation):
            mujoco.mj_step(model, data)
            if monitor is not None:
                monitor(model, data)
        out["qpos"][t], out["qvel"][t] = data.qpos, data.qvel
    return data, out
