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
    Block,
    own_object,
    positive_quat,
)
from flashdex.geometry.rotation import quat_conj, quat_mul, quat_rotate_inverse


def object_state(
    kin: TensorDictBase, own_pos: Tensor, own_quat: Tensor, own_vel: Tensor
) -> Tensor:
    """Own object's pose and velocity in the wrist frame, (N, 2, 13)."""
    quat = kin["wrist_quat"]
    parts = [
        quat_rotate_inverse(quat, own_pos - kin["wrist_pos"]),
        positive_quat(quat_mul(quat_conj(quat), own_quat)),
        quat_rotate_inverse(quat, own_vel[..., :3]) * LINVEL_SCALE,
        quat_rotate_inverse(quat, own_vel[..., 3:]) * ANGVEL_SCALE,
    ]
    return torch.cat(parts, -1)


@observation("object_state", needs_object=True)
class ObjectState(Block):
    """Own object's pose and velocity in the wrist frame."""

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``object_state``."""
        return object_state(td[keys.KIN], *own_object(td, "pos", "quat", "vel"))
