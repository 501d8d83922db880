"""Open-loop replay of stored controls in MuJoCo C, and the signals of what happened.

No wrench, no feedback, no reset: the first state, the control rows, and the model of
the file. Fingertips and links are recomputed from the model's sites and bodies.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from flashdex.errors import RunError
from flashdex.keys import FINGERS, SIDES
from flashdex.metrics.errors import Signals, compute_signals
from flashdex.rollouts.rollout import Rollout

# a proof may cost more than training: solver effort of at least these (method, sec. 17)
MIN_ITERATIONS, MIN_LS_ITERATIONS = 100, 200
# MuJoCo goes on after these, with contacts dropped or controls set to zero
NUMERIC_WARNINGS = (
    "mjWARN_CONTACTFULL",
    "mjWARN_CNSTRFULL",
    "mjWARN_BADCTRL",
    "mjWARN_BADQPOS",
    "mjWARN_BADQVEL",
    "mjWARN_BADQACC",
)

StepMonitor = Callable[[mujoco.MjModel, mujoco.MjData], None]


@dataclass(frozen=True)
class Scene:
    """A compiled model and where the rollout's objects and hands are in it.

    Args:
        model: compiled model.
        object_body: body of each object slot, -1 when empty, (O,).
        object_adr: qpos address of each slot, -1 when empty, (O,).
        pad_sites: fingertip sites, (2, 5), -1 when absent.
        joint_bodies: bodies of ``joints``, (2, M).
        wrist_bodies: (2,), -1 when absent.
    """

    model: mujoco.MjModel
    object_body: np.ndarray
    object_adr: np.ndarray
    pad_sites: np.ndarray
    joint_bodies: np.ndarray
    wrist_bodies: np.ndarray


@dataclass(frozen=True)
class Replay:
    """States and counts of one open-loop run; world, m, rad, wxyz.

    Args:
        qpos: after each control step, (T, nq).
        signals: errors against the rollout's reference.
        warnings: MuJoCo warning -> times raised.
        nan_count: values of the states that are not finite.
        wrench_max: largest applied force or torque seen, N or N m.
    """

    qpos: np.ndarray
    signals: Signals
    warnings: dict[str, int]
    nan_count: int
    wrench_max: float


def load_scene(rollout: Rollout) -> Scene:
    """Compile the model of a rollout and find its parts; RunError when they are absent.

    Args:
        rollout: a checked rollout.
    """
    try:
        model = mujoco.MjModel.from_xml_string(rollout.model_xml)
    except ValueError as error:
        raise RunError(
            f"{rollout.motion}: model_xml does not compile: {error}"
        ) from None
    model.opt.iterations = max(model.opt.iterations, MIN_ITERATIONS)
    model.opt.ls_iterations = max(model.opt.ls_iterations, MIN_LS_ITERATIONS)
    # a diverged state must stay visible instead of being reset
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _check_sizes(model, rollout)
    adr = np.asarray(rollout.object_qpos_adr, dtype=np.int64)
    wrists = json.loads(rollout.wrist_bodies or "[null, null]")
    active = rollout.hand_active.astype(bool)
    named = [n if on else None for n, on in zip(wrists, active, strict=True)]
    return Scene(
        model=model,
        object_body=np.array([_free_body(model, a, rollout.motion) for a in adr]),
        object_adr=adr,
        pad_sites=np.array([[_site(model, s, f) for f in FINGERS] for s in SIDES]),
        joint_bodies=_joint_bodies(model, rollout),
        wrist_bodies=np.array([_body(model, n, rollout.motion) for n in named]),
    )


def _joint_bodies(model: mujoco.MjModel, rollout: Rollout) -> np.ndarray:
    links = json.loads(rollout.joint_bodies)
    count = rollout.joints.shape[2]
    if len(links) != 2 or any(len(side) not in (0, count) for side in links):
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
    for key, value, size in (
        ("qpos0", rollout.qpos0, model.nq),
        ("qvel0", rollout.qvel0, model.nv),
        ("ctrl", rollout.ctrl, model.nu),
    ):
        if value.shape[-1] != size:
            raise RunError(
                f"{rollout.motion}: {key} has {value.shape[-1]} columns, the model "
                f"needs {size}. Model and states are not of the same scene."
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
    """SHA-256 of the compiled model.

    Args:
        model: compiled model.
    """
    buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def replay_points(scene: Scene, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Fingertips, links and wrists at given joint positions, by forward kinematics.

    Args:
        scene: model and addresses.
        qpos: (T, nq).

    Returns:
        ``fingertips`` (T, 2, 5, 3), ``joints`` (T, 2, M, 3), ``wrist_pos`` (T, 2, 3),
        world, m; NaN for absent parts.
    """
    data = mujoco.MjData(scene.model)
    rows: dict[str, list[np.ndarray]] = {
        "fingertips": [],
        "joints": [],
        "wrist_pos": [],
    }
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(scene.model, data)
        rows["fingertips"].append(data.site_xpos[scene.pad_sites])
        rows["joints"].append(data.xpos[scene.joint_bodies])
        rows["wrist_pos"].append(data.xpos[scene.wrist_bodies])
    parts = scene.pad_sites, scene.joint_bodies, scene.wrist_bodies
    points = {key: np.stack(values) for key, values in rows.items()}
    for value, index in zip(points.values(), parts, strict=True):
        value[:, index < 0] = np.nan
    return points


def _object_poses(scene: Scene, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    poses = [
        qpos[:, a : a + 7] if a >= 0 else np.full((len(qpos), 7), np.nan)
        for a in scene.object_adr
    ]
    pose = np.stack(poses, axis=1)
    return pose[..., :3], pose[..., 3:]


def replay_signals(
    scene: Scene, rollout: Rollout, qpos: np.ndarray, *, overflow: bool = False
) -> Signals:
    """Errors of re-simulated states against the rollout's reference.

    Args:
        scene: model and addresses.
        rollout: reference and masks.
        qpos: (T, nq).
        overflow: the engine warned of numerics.
    """
    parts = scene.pad_sites, scene.joint_bodies, scene.wrist_bodies
    active = np.flatnonzero(rollout.hand_active)
    # a part that the model lacks is a hole of the file, not a failure
    data: dict[str, np.ndarray | None] = {
        key: None if (index[active] < 0).any() else points
        for (key, points), index in zip(
            replay_points(scene, qpos).items(), parts, strict=True
        )
    }
    data["object_pos"], data["object_quat"] = _object_poses(scene, qpos)
    for key in ("object_pos", "object_quat", "fingertips", "joints", "wrist_pos"):
        data[f"ref_{key}"] = getattr(rollout, f"ref_{key}")
    return compute_signals(
        data,
        hand_active=rollout.hand_active.tolist(),
        hand_object=rollout.hand_object.tolist(),
        fps=rollout.fps,
        num_ref_frames=rollout.reference_length,
        overflow=overflow,
    )


def resimulate(
    scene: Scene,
    rollout: Rollout,
    *,
    qpos0: np.ndarray | None = None,
    ctrl: np.ndarray | None = None,
    monitor: StepMonitor | None = None,
) -> Replay:
    """Apply the stored controls open loop from the stored first state.

    Args:
        scene: model (possibly perturbed) and addresses.
        rollout: first state, controls, reference.
        qpos0: other first positions, (nq,).
        ctrl: other controls, (T, nu).
        monitor: called after every substep.
    """
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = rollout.qpos0 if qpos0 is None else qpos0
    data.qvel[:] = rollout.qvel0
    if rollout.act0 is not None and model.na:
        data.act[:] = rollout.act0
    controls = rollout.ctrl if ctrl is None else ctrl
    qpos = np.empty((len(controls), model.nq))
    nan_count, wrench_max = 0, 0.0
    for t, row in enumerate(controls):
        data.ctrl[:] = row
        for _ in range(rollout.decimation):
            mujoco.mj_step(model, data)
            if monitor is not None:
                monitor(model, data)
        qpos[t] = data.qpos
        nan_count += int(
            (~np.isfinite(data.qpos)).sum() + (~np.isfinite(data.qvel)).sum()
        )
        applied = max(np.abs(data.xfrc_applied).max(), np.abs(data.qfrc_applied).max())
        wrench_max = max(wrench_max, float(applied))
    warnings = _warnings(data)
    overflow = any(warnings[name] for name in NUMERIC_WARNINGS) or nan_count > 0
    signals = replay_signals(scene, rollout, qpos, overflow=overflow)
    return Replay(qpos, signals, warnings, nan_count, wrench_max)


def _warnings(data: mujoco.MjData) -> dict[str, int]:
    kinds = mujoco.mjtWarning.__members__
    return {
        name: int(data.warning[kind].number)
        for name, kind in kinds.items()
        if name.startswith("mjWARN_")
    }
