"""Observation block: the robot's own pose, velocities, joints and fingertips."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import observation
from flashdex.envs.transforms.base import (
    ANGVEL_SCALE,
    JOINT_VEL_SCALE,
    LINVEL_SCALE,
    to_wrist,
)

_READS = (keys.KIN, keys.JOINT_POS, keys.JOINT_VEL, keys.JOINT_TARGET)


@observation(inputs=lambda td: tuple(td[key] for key in _READS))
def proprioception(
    kin: TensorDictBase, joint_pos: Tensor, joint_vel: Tensor, joint_target: Tensor
) -> Tensor:
    """Palm pose, velocities, joints, fingertips, target error.

    Args:
        kin: forward kinematics, batch (N,).
        joint_pos: (N, 2, J).
        joint_vel: (N, 2, J).
        joint_target: position targets, (N, 2, J).

    Returns:
        (N, 2, 43 + 3 J); 97 numbers a hand for XHand.
    """
    pos, quat = kin["wrist_pos"], kin["wrist_quat"]
    tips = to_wrist(quat, kin["tip_pos"] - pos.unsqueeze(-2)).flatten(-2)
    tip_vel = to_wrist(quat, kin["tip_linvel"]).flatten(-2) * LINVEL_SCALE
    parts = [
        pos,
        quat,
        kin["wrist_linvel"] * LINVEL_SCALE,
        kin["wrist_angvel"] * ANGVEL_SCALE,
        joint_pos,
        joint_vel * JOINT_VEL_SCALE,
        tips,
        tip_vel,
        joint_target - joint_pos,
    ]
    return torch.cat(parts, -1)
