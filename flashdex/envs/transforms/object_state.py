"""Observation block: pose and velocity of each hand's own object."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import observation
from flashdex.envs.transforms.base import (
    ANGVEL_SCALE,
    LINVEL_SCALE,
    own_object,
    positive_quat,
)
from flashdex.geometry.rotation import quat_conj, quat_mul, quat_rotate_inverse


@observation(
    inputs=lambda td: (td[keys.KIN], *own_object(td, "pos", "quat", "vel")),
    needs_object=True,
)
def object_state(
    kin: TensorDictBase, own_pos: Tensor, own_quat: Tensor, own_vel: Tensor
) -> Tensor:
    """Own object's pose and velocity in the wrist frame.

    Args:
        kin: forward kinematics.
        own_pos: own object, world, m, (N, 2, 3).
        own_quat: (N, 2, 4).
        own_vel: (N, 2, 6).

    Returns:
        (N, 2, 13).
    """
    quat = kin["wrist_quat"]
    parts = [
        quat_rotate_inverse(quat, own_pos - kin["wrist_pos"]),
        positive_quat(quat_mul(quat_conj(quat), own_quat)),
        quat_rotate_inverse(quat, own_vel[..., :3]) * LINVEL_SCALE,
        quat_rotate_inverse(quat, own_vel[..., 3:]) * ANGVEL_SCALE,
    ]
    return torch.cat(parts, -1)
