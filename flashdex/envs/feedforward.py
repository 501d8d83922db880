"""Position targets under which the servos of the wrist follow the reference.

A servo trails a target that moves, by ``M q'' + ... = kp (target - q) - kv q'``.
Targets ahead of the reference make up for that; fingers carry little and need none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from flashdex import keys
from flashdex.envs.scene.scene import make_hands_spec
from flashdex.hands.gains import NUM_WRIST_JOINTS, servo_lag
from flashdex.hands.spec import HandSpec

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.motions.library import MotionLibrary

Feedforward = Literal["none", "lag", "inverse"]
_WRIST = slice(0, NUM_WRIST_JOINTS)


def reference_targets(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    feedforward: Feedforward,
) -> Tensor:
    """Targets of all reference frames: the reference itself, its wrist ahead of it.

    ``lag`` adds what the servo trails a steady motion by, ``(kv + damping) / kp q'``;
    ``inverse`` all of the inverse dynamics, ``(tau(q, q', q'') + kv q') / kp`` at the
    middle of the control step that ends with the frame.

    Returns:
        m and rad, (F, 2, J), float32.
    """
    pos, vel = library.frames["joint_pos"], library.frames["joint_vel"]
    out = pos.float().clone()
    if feedforward == "none":
        return out
    sides: list[keys.Side] = [
        side
        for i, side in enumerate(keys.SIDES)
        if library.motions["hand_active"][:, i].any()
    ]
    model = make_hands_spec(tuple(sides), hands, physics).compile()
    # joint limits and friction are the solver's business, not the feed-forward's
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    for side in sides:
        i, gains = keys.SIDES.index(side), hands[side].gains[physics.gains]
        q, v = (x[:, i].double().numpy() for x in (pos, vel))
        if feedforward == "lag":
            ahead = servo_lag(gains) * v
        else:
            force = _inverse(model, hands[side], q, v, _acceleration(library, v))
            ahead = _middle(library, (force + gains.kv * v) / gains.kp + q) - q
        active = library.motions["hand_active"][:, i].bool()
        rows = torch.repeat_interleave(active, library.motions["length"].long())
        ahead = torch.from_numpy(ahead[:, _WRIST]).float()
        out[rows, i, _WRIST] += ahead[rows]
    return out


def _motions(library: MotionLibrary) -> list[slice]:
    starts, lengths = (library.motions[k].tolist() for k in ("start", "length"))
    return [slice(s, s + n) for s, n in zip(starts, lengths, strict=True)]


def _acceleration(library: MotionLibrary, vel: np.ndarray) -> np.ndarray:
    """Central differences within each motion, (F, J)."""
    out = np.zeros_like(vel)
    for frames in _motions(library):
        if frames.stop - frames.start > 1:
            out[frames] = np.gradient(vel[frames], axis=0) * library.fps
    return out


def _middle(library: MotionLibrary, values: np.ndarray) -> np.ndarray:
    """Mean of each frame and the one before it in its motion, (F, J)."""
    out = values.copy()
    for frames in _motions(library):
        own = values[frames]
        out[frames][1:] = 0.5 * (own[1:] + own[:-1])
    return out


def _inverse(
    model: mujoco.MjModel,
    hand: HandSpec,
    pos: np.ndarray,
    vel: np.ndarray,
    acc: np.ndarray,
) -> np.ndarray:
    """Forces of inverse dynamics at the joints of one hand, N and N m, (F, J)."""
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in hand.joint_names]
    adr = np.array([joint.qposadr[0] for joint in joints])
    dof = np.array([joint.dofadr[0] for joint in joints])
    out = np.empty_like(pos)
    for t in range(len(pos)):
        data.qpos[adr], data.qvel[dof], data.qacc[dof] = pos[t], vel[t], acc[t]
        mujoco.mj_inverse(model, data)
        out[t] = data.qfrc_inverse[dof]
    return out
