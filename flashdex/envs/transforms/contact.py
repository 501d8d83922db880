"""Observation block: contact wrench of each link, coded in seven bytes.

What physics alone knows has to be stored in replay, next to the state. A link's
contact with the object of its hand is one net force and one force-weighted point;
seven signed bytes hold it: direction (3), log magnitude (1), point in the link's
frame (3). The environment emits the codes, so that the policy and the replay sample
decode the very same numbers.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.term import observation
from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
)

CODE_WIDTH = 7
MAX_FORCE = 500.0  # N; larger forces saturate
POINT_RANGE = 0.1  # m; links are shorter than this around their frame
_LOG_MAX = math.log1p(MAX_FORCE)


def encode_contact(force: Tensor, point: Tensor) -> Tensor:
    """Code forces and points; links without contact give all zeros.

    Args:
        force: net contact force on the link, link frame, N, (..., 3).
        point: force-weighted contact point, link frame, m, (..., 3).

    Returns:
        int8 codes, (..., 7).
    """
    size = force.norm(dim=-1, keepdim=True)
    direction = force / size.clamp_min(1e-9)
    magnitude = (torch.log1p(size) / _LOG_MAX).clamp(max=1.0)
    code = torch.cat([direction, magnitude, point / POINT_RANGE], -1)
    code = torch.round(code.clamp(-1, 1) * 127)
    return torch.where(size > 1e-6, code, torch.zeros_like(code)).to(torch.int8)


def contact_code(wrench: Tensor, kin: TensorDictBase) -> Tensor:
    """Code the engine's net force and point of each link, (N, 2, L, 7) int8.

    Args:
        wrench: force on the link and force-weighted point, world, N and m,
            (N, 2, L, 6).
        kin: forward kinematics of the same state, batch (N, 2).
    """
    force = quat_rotate_inverse(kin["link_quat"], wrench[..., :3])
    lever = wrench[..., 3:] - kin["link_pos"]
    return encode_contact(force, quat_rotate_inverse(kin["link_quat"], lever))


def decode_contact(code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Invert ``encode_contact``.

    Args:
        code: int8 codes, (..., 7).

    Returns:
        Unit direction (..., 3), ``log(1 + force)`` (..., 1) with the force in N,
        and the contact point in the link frame, m, (..., 3).
    """
    value = code.float() / 127
    direction = value[..., :3]
    size = direction.norm(dim=-1, keepdim=True)
    direction = direction / size.clamp_min(1e-6)
    return direction, value[..., 3:4] * _LOG_MAX, value[..., 4:] * POINT_RANGE


@observation(inputs=lambda td: (td[keys.KIN], td[keys.CONTACT]), needs_object=True)
def contact(kin: TensorDictBase, code: Tensor) -> Tensor:
    """Contact wrench and contact point of each link, in the wrist frame.

    (N, 2, 11 L): force and torque about the link origin as
    (unit vector * log(1 + n), log(1 + n)), then the point relative to the palm; zeros
    without contact.

    Args:
        kin: forward kinematics.
        code: contact codes, (N, 2, L, 7) int8.
    """
    direction, log_force, lever = decode_contact(code)
    quat = kin["wrist_quat"].unsqueeze(-2)
    in_wrist = quat_mul(quat_conj(quat), kin["link_quat"])
    force = torch.expm1(log_force)
    torque = torch.linalg.cross(lever, direction * force, dim=-1)
    torque_size = torque.norm(dim=-1, keepdim=True)
    log_torque = torch.log1p(torque_size)
    unit_torque = torque / torque_size.clamp_min(1e-9)
    touches = (log_force > 0).to(lever.dtype)
    origin = quat_rotate_inverse(quat, kin["link_pos"] - kin["wrist_pos"].unsqueeze(-2))
    point = (origin + quat_rotate(in_wrist, lever)) * touches
    parts = [
        quat_rotate(in_wrist, direction) * log_force,
        log_force,
        quat_rotate(in_wrist, unit_torque) * log_torque,
        log_torque,
        point,
    ]
    return torch.cat(parts, -1).flatten(-2)
