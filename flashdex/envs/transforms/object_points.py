"""Observation block: surface points of each hand's own object."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import number, observation
from flashdex.envs.transforms.base import Block, BlockContext, own_object
from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
)


def object_points(
    kin: TensorDictBase,  # forward kinematics
    ref: TensorDictBase,  # reference frame shown to the policy
    own_pos: Tensor,  # own object, world, m, (N, 2, 3)
    own_quat: Tensor,  # own object, (N, 2, 4)
    points: Tensor,  # object frame, m, (N, 2, P, 3)
) -> Tensor:
    """Eq. (3): surface points now, and their displacement to the next reference.

    Returns:
        Wrist frame, m, (N, 2, 6 P): points, then next reference minus current.
    """
    quat = kin["wrist_quat"]
    # One rotation takes object axes to wrist axes; the offset is added after it.
    to_object = quat_mul(quat_conj(quat), own_quat).unsqueeze(-2)
    offset = quat_rotate_inverse(quat, own_pos - kin["wrist_pos"]).unsqueeze(-2)
    current = quat_rotate(to_object, points) + offset
    to_ref = quat_mul(quat_conj(quat), ref["own_quat"]).unsqueeze(-2)
    ref_offset = quat_rotate_inverse(quat, ref["own_pos"] - kin["wrist_pos"])
    reference = quat_rotate(to_ref, points) + ref_offset.unsqueeze(-2)
    delta = reference - current
    return torch.cat([current.flatten(-2), delta.flatten(-2)], -1)


@observation("object_points", needs_object=True)
class ObjectPoints(Block):
    """Surface points of each hand's object, now and next, in the wrist frame.

    Args:
        context: holds the points.
        num_points: Points an object, taken from the front of the farthest-point order;
            fewer is faster and coarser.
    """

    points: Tensor  # object frame, m, (Q, P, 3)

    def __init__(
        self, context: BlockContext, *, num_points: int = number(128, low=1, high=128)
    ) -> None:
        super().__init__(context)
        self.register_buffer("points", context.bank.points[:, :num_points])

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``object_points``."""
        pos, quat, row = own_object(td, "pos", "quat", "row")
        return object_points(td[keys.KIN], td[keys.REF], pos, quat, self.points[row])
