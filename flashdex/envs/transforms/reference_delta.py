"""Observation block: what the next reference frame is away from robot and object."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import observation
from flashdex.envs.transforms.base import Block, BlockContext, own_object, positive_quat
from flashdex.geometry.rotation import quat_conj, quat_mul, quat_rotate_inverse


def reference_delta(
    kin: TensorDictBase,  # forward kinematics
    ref: TensorDictBase,  # reference frame shown to the policy
    own_pos: Tensor,  # own object, world, m, (N, 2, 3)
    own_quat: Tensor,  # own object, (N, 2, 4)
    links: Tensor,  # indices of the mapped links, (2, Q)
) -> Tensor:
    """Next reference minus robot: mapped links and tips (world), object (wrist).

    Returns:
        (N, 2, 6 (Q + 5) + 7).
    """
    side = torch.arange(2, device=links.device).unsqueeze(-1)
    link_pos = kin["link_pos"][:, side, links]
    link_vel = kin["link_linvel"][:, side, links]
    robot_pos = torch.cat([link_pos, kin["tip_pos"]], -2)
    robot_vel = torch.cat([link_vel, kin["tip_linvel"]], -2)
    ref_pos = torch.cat([ref["link_pos"], ref["tip_pos"]], -2)
    ref_vel = torch.cat([ref["link_linvel"], ref["tip_linvel"]], -2)
    wrist = kin["wrist_quat"]
    # R_w^T R_ref R_cur^T R_w
    turn = quat_mul(ref["own_quat"], quat_conj(own_quat))
    turn = quat_mul(quat_mul(quat_conj(wrist), turn), wrist)
    parts = [
        (ref_pos - robot_pos).flatten(-2),
        (ref_vel - robot_vel).flatten(-2),
        quat_rotate_inverse(wrist, ref["own_pos"] - own_pos),
        positive_quat(turn),
    ]
    return torch.cat(parts, -1)


@observation("reference_delta")
class ReferenceDelta(Block):
    """Next reference minus robot and object."""

    links: Tensor  # (2, Q)

    def __init__(self, context: BlockContext) -> None:
        super().__init__(context)
        pairs = [context.hands[s].keypoint_links for s in keys.SIDES]
        links = [[link for link, _ in pair] for pair in pairs]
        self.register_buffer("links", torch.tensor(links))

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``reference_delta``."""
        pos, quat = own_object(td, "pos", "quat")
        return reference_delta(td[keys.KIN], td[keys.REF], pos, quat, self.links)
