"""What the re-simulation did to hand and object: penetration, force, joint limits."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

HAND, SUPPORT = -1, -2  # geom kinds; objects are their slot, 0 and up
# beyond these a joint counts as outside its range: MuJoCo limits are soft
LIMIT_TOLERANCE_RAD, LIMIT_TOLERANCE_M = 1e-2, 1e-3
GRAVITY, GRAVITY_TOLERANCE = 9.81, 0.01


def geom_kinds(model: mujoco.MjModel, object_body: np.ndarray) -> np.ndarray:
    """Slot of each geom's object, or HAND (moving), or SUPPORT (fixed), (ngeom,)."""
    body = model.geom_bodyid
    kinds = np.where(model.body_weldid[body] == 0, SUPPORT, HAND)
    for slot, root in enumerate(object_body):
        if root >= 0:
            kinds[model.body_rootid[body] == model.body_rootid[root]] = slot
    return kinds


def assist_sources(model: mujoco.MjModel, object_body: np.ndarray) -> list[str]:
    """What in a model could carry an object besides contact: none is allowed.

    ``object_body`` is the body of each slot, -1 when empty, (O,).
    """
    roots = model.body_rootid[object_body[object_body >= 0]]
    in_object = np.isin(model.body_rootid, roots)
    joints = np.isin(model.jnt_bodyid, np.flatnonzero(in_object))
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    on_joint = np.isin(model.actuator_trntype, kinds)
    driven = joints[model.actuator_trnid[on_joint, 0]]
    on_body = model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY
    held = in_object[model.actuator_trnid[on_body, 0]]
    is_body_pair = model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY
    pairs = np.stack([model.eq_obj1id, model.eq_obj2id])[:, is_body_pair]
    found = {
        "gravcomp": (model.body_gravcomp[in_object] != 0).any(),
        "actuator": driven.any() or held.any(),
        "equality": in_object[pairs].any(),
        "gravity": abs(np.linalg.norm(model.opt.gravity) - GRAVITY) > GRAVITY_TOLERANCE,
    }
    return [name for name, present in found.items() if present]


def normal_forces(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Normal force of every contact of the last step, N, (ncon,); 0 where inactive."""
    wrench = np.zeros((data.ncon, 6))
    for contact, row in enumerate(wrench):
        mujoco.mj_contactForce(model, data, contact, row)
    return wrench[:, 0]


class SafetyMonitor:
    """Collects peaks over all substeps; call it after every ``mj_step``.

    ``object_body`` is the body of each slot, -1 when empty, (O,).
    """

    def __init__(self, model: mujoco.MjModel, object_body: np.ndarray) -> None:
        gravity = float(np.linalg.norm(model.opt.gravity))
        masses = [model.body_subtreemass[b] if b >= 0 else np.nan for b in object_body]
        self._kinds = geom_kinds(model, object_body)
        self._weights = np.array(masses) * gravity  # N, (O,)
        self.peaks = {
            "penetration_hand_object": 0.0,  # m
            "penetration_object_support": 0.0,  # m
            "force": 0.0,  # normal force of any contact, N
            "force_ratio": 0.0,  # of a contact of an object, over its weight
            "contacts": 0,
        }

    def _keep(self, name: str, values: np.ndarray) -> None:
        self.peaks[name] = max(self.peaks[name], float(values.max(initial=0.0)))

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Take in one substep."""
        self.peaks["contacts"] = max(self.peaks["contacts"], int(data.ncon))
        if not data.ncon:
            return
        geoms = data.contact.geom
        rigid = (geoms >= 0).all(axis=1)
        pair = np.where(rigid[:, None], self._kinds[geoms], SUPPORT)
        # sorted: the object's slot, if any, is last
        pair = np.sort(pair, axis=1)
        has_object = pair[:, 1] >= 0
        depth = np.maximum(-data.contact.dist, 0.0)
        for name, kind in (("hand_object", HAND), ("object_support", SUPPORT)):
            self._keep(f"penetration_{name}", depth[has_object & (pair[:, 0] == kind)])
        force = normal_forces(model, data)
        self._keep("force", force)
        weight = self._weights[pair[has_object, 1]]
        ratio = force[has_object][weight > 0] / weight[weight > 0]
        self._keep("force_ratio", ratio)

    def to_dict(self) -> dict[str, Any]:
        """Peaks in mm and N."""
        hand, support, force, ratio, contacts = self.peaks.values()
        return {
            "penetration_max_mm": max(hand, support) * 1e3,
            "penetration_hand_object_mm": hand * 1e3,
            "penetration_object_support_mm": support * 1e3,
            "force_peak": force,
            "force_peak_ratio": ratio,
            "contacts_max": contacts,
        }


def joint_limit_violations(model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, Any]:
    """Samples of limited slide and hinge joints outside their range, of qpos (T, nq).

    Returns:
        ``count`` of samples beyond the tolerance, ``max_rad``, ``max_m``.
    """
    result: dict[str, Any] = {"count": 0, "max_rad": 0.0, "max_m": 0.0}
    for kind, key, tolerance in (
        (mujoco.mjtJoint.mjJNT_HINGE, "max_rad", LIMIT_TOLERANCE_RAD),
        (mujoco.mjtJoint.mjJNT_SLIDE, "max_m", LIMIT_TOLERANCE_M),
    ):
        joints = np.flatnonzero(
            (model.jnt_type == kind) & model.jnt_limited.astype(bool)
        )
        value = qpos[:, model.jnt_qposadr[joints]]
        low, high = model.jnt_range[joints].T
        excess = np.maximum(low - value, value - high)
        result[key] = float(excess.max(initial=0.0))
        result["count"] += int((excess > tolerance).sum())
    return result


def state_deviation(
    model: mujoco.MjModel, qpos: np.ndarray, stored: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Largest distance of any joint between two runs (T, nq), over time.

    Returns:
        Translation of slide and free joints, m, (T,); rotation of hinge, ball and free
        joints, rad, (T,).
    """
    shift, turn = np.zeros((2, len(qpos)))
    types = mujoco.mjtJoint
    for kind, adr in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        delta = qpos[:, adr] - stored[:, adr]
        if kind == types.mjJNT_SLIDE:
            shift = np.maximum(shift, np.abs(delta))
        elif kind == types.mjJNT_HINGE:
            turn = np.maximum(turn, np.abs(delta))
        else:
            quat = adr + 3 if kind == types.mjJNT_FREE else adr
            if kind == types.mjJNT_FREE:
                move = qpos[:, adr : adr + 3] - stored[:, adr : adr + 3]
                shift = np.maximum(shift, np.linalg.norm(move, axis=1))
            rows = slice(quat, quat + 4)
            turn = np.maximum(turn, _quat_angle(qpos[:, rows], stored[:, rows]))
    return shift, turn


def _quat_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # |a - b| and |a + b| are 2 sin and 2 cos of a quarter of the turn, up to order
    near = np.linalg.norm(a - b, axis=1)
    far = np.linalg.norm(a + b, axis=1)
    return 4 * np.arctan2(np.minimum(near, far), np.maximum(near, far))
