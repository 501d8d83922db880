"""Observation block: how far palm and fingertips are from the own object, Eq. (7).

A fingertip is the sphere at the end of its distal link, so its distance is
``SDF(center) - radius``; radius 0 is the paper's point.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import observation
from flashdex.envs.reference import stack_hands
from flashdex.envs.transforms.base import Block, BlockContext, own_object, to_wrist
from flashdex.geometry.rotation import quat_rotate, quat_rotate_inverse
from flashdex.geometry.sdf import SdfGrid


def fingertip_distance(
    kin: TensorDictBase,  # forward kinematics
    own_pos: Tensor,  # own object, world, m, (N, 2, 3)
    own_quat: Tensor,  # own object, (N, 2, 4)
    rows: Tensor,  # object row of each hand, (N, 2)
    sdf: SdfGrid,  # distance grids of all objects
    tip_radius: Tensor,  # m, (2, 5)
) -> tuple[Tensor, Tensor]:
    """Eq. (7): signed distance of palm and fingertips to the own object.

    Returns:
        Distances of palm, then tips, m, (N, 2, 6), and surface normals in the wrist
        frame, (N, 2, 6, 3).
    """
    probes = torch.cat([kin["wrist_pos"].unsqueeze(-2), kin["tip_center"]], -2)
    distance, normal = _query(probes, own_pos, own_quat, rows, sdf)
    palm = torch.zeros_like(tip_radius[:, :1])
    distance = distance - torch.cat([palm, tip_radius], -1)
    normal = quat_rotate(own_quat.unsqueeze(-2), normal)
    return distance, to_wrist(kin["wrist_quat"], normal)


def tip_distance(
    kin: TensorDictBase,
    own_pos: Tensor,
    own_quat: Tensor,
    rows: Tensor,
    sdf: SdfGrid,
    tip_radius: Tensor,
) -> Tensor:
    """The same for the fingertips alone, without normals; (N, 2, 5)."""
    return _query(kin["tip_center"], own_pos, own_quat, rows, sdf)[0] - tip_radius


def _query(
    probes: Tensor, own_pos: Tensor, own_quat: Tensor, rows: Tensor, sdf: SdfGrid
) -> tuple[Tensor, Tensor]:
    local = probes - own_pos.unsqueeze(-2)
    local = quat_rotate_inverse(own_quat.unsqueeze(-2), local)
    return sdf.query(local, rows.unsqueeze(-1).expand(local.shape[:-1]))


@observation("surface_distance", needs_object=True)
class SurfaceDistance(Block):
    """Signed distance and surface normal at palm and fingertips."""

    tip_radius: Tensor  # m, (2, 5)

    def __init__(self, context: BlockContext) -> None:
        super().__init__(context)
        self.sdf = context.bank.sdf
        self.register_buffer("tip_radius", stack_hands(context.hands, "tip_radius"))

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``fingertip_distance``."""
        pos, quat, row = own_object(td, "pos", "quat", "row")
        distance, normal = fingertip_distance(
            td[keys.KIN], pos, quat, row, self.sdf, self.tip_radius
        )
        return torch.cat([distance, normal.flatten(-2)], -1)
