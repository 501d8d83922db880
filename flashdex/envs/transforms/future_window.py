"""Observation of the coming reference frames, the input of the future encoder."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import number, observation
from flashdex.envs.transforms.base import BlockContext, StateTransform, own_object
from flashdex.geometry.rotation import quat_conj, quat_mul, quat_to_matrix

BOUND = 100.0  # a diverged world must not poison the statistics


def future_window(
    kin: TensorDictBase,
    vectors: Tensor,
    rotations: Tensor,
    own_pos: Tensor,
    own_quat: Tensor,
    own_vel: Tensor,
) -> Tensor:
    """Eq. (4): coming reference frames relative to the current simulation.

    All frames of a hand share its wrist rotation, so each quantity is one small matrix
    product a hand instead of one a frame.

    Args:
        kin: forward kinematics.
        vectors: object position, linear, angular velocity, wrist position and five
            fingertips of the coming frames, world, (N, K, 2, 9, 3).
        rotations: transposed rotation matrices of object and wrist, (N, K, 2, 2, 3, 3).
        own_pos: own object, world, m, (N, 2, 3).
        own_quat: own object, (N, 2, 4).
        own_vel: own object, (N, 2, 6).

    Returns:
        (N, 2, 39, K): object position 3, rotation 6, linear 3, angular 3, wrist
        position 3, rotation 6, fingertips 15; all in the current wrist frame. Rotations
        are the first two columns of ``R_w^T R_ref R_cur^T R_w``.
    """
    frames = vectors.shape[1]
    wrist = quat_to_matrix(kin["wrist_quat"])
    now = torch.stack([own_pos, *own_vel.split(3, -1), kin["wrist_pos"]], -2)
    now = torch.cat([now, kin["tip_pos"]], -2)
    # (N, 2, K * 9, 3) @ (N, 2, 3, 3): a row vector times R_w is R_w^T v.
    delta = (vectors - now.unsqueeze(1)).transpose(1, 2).flatten(2, 3) @ wrist
    delta = delta.unflatten(2, (frames, 9))
    # Columns of R_cur^T R_w for object and wrist; the wrist's is the identity.
    turn = quat_to_matrix(quat_mul(quat_conj(own_quat), kin["wrist_quat"]))
    eye = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
    columns = torch.stack([turn, eye], 2)[..., :2]
    # R_ref^T R_w of every frame, transposed back to R_w^T R_ref, then times columns.
    turned = rotations.permute(0, 2, 3, 1, 4, 5).flatten(3, 4)
    turned = (turned @ wrist.unsqueeze(2)).unflatten(3, (frames, 3)).mT
    rot = (turned.flatten(3, 4) @ columns).unflatten(3, (frames, 3))
    # Column 1 before column 2.
    rot = rot.mT.flatten(-2)
    parts = [
        delta[..., 0, :],
        rot[:, :, 0],
        delta[..., 1, :],
        delta[..., 2, :],
        delta[..., 3, :],
        rot[:, :, 1],
        delta[..., 4:, :].flatten(-2),
    ]
    return torch.cat(parts, -1).transpose(-1, -2)


@observation("future_window")
class FutureWindow(StateTransform):
    """Reference of the coming frames relative to the current simulation.

    Writes ``keys.FUTURE``, (N, 39 x hands, K), beside the observation.

    Args:
        context: holds the reference frames.
        horizon: Frames in the window, control steps; the encoder needs at least 6.
    """

    def __init__(
        self, context: BlockContext, *, horizon: int = number(10, low=6, high=60)
    ) -> None:
        super().__init__(
            in_keys=[keys.KIN, keys.OWN, keys.GROUP_MASK, keys.MOTION, keys.FRAME],
            out_keys=[keys.FUTURE],
        )
        self.bank, self.horizon = context.bank, horizon
        self.reference_offset = context.reference_offset
        self.hands = context.used_hands

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """See ``future_window``."""
        motion = td[keys.MOTION].squeeze(-1)
        frame = td[keys.FRAME].squeeze(-1) + self.reference_offset
        window = self.bank.window(motion, frame, self.horizon)
        own = own_object(td, "pos", "quat", "vel")
        values = future_window(td[keys.KIN], *window, *own)
        mask = td[keys.GROUP_MASK][..., None, None]
        values = torch.where(mask, values, torch.zeros_like(values))
        values = torch.nan_to_num(values).clamp(-BOUND, BOUND)
        return {keys.FUTURE: values[:, self.hands].flatten(1, 2)}
