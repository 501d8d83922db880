"""Observation features as pure tensor functions (method sections 6 to 8).

Inputs are forward kinematics ``kin`` (``HandKinematics``), reference frames ``ref``
(``ReferenceBank.at``) and the state of each hand's own object. Leading dimensions are
(N, 2): worlds and hands. Suffix ``_wrist``: wrist frame of that hand.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex.envs.transforms.contact_code import decode_contact
from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_matrix,
)
from flashdex.geometry.sdf import SdfGrid

# Scales of method section 6 that bring speeds near one.
_LINVEL, _ANGVEL, _JOINT_VEL = 2.0, 0.25, 0.1


def gather_own(values: Tensor, slot: Tensor) -> Tensor:
    """Pick each hand's own object: (N, O, C) by slots (N, 2) to (N, 2, C)."""
    index = slot.unsqueeze(-1).expand(-1, -1, values.shape[-1])
    return torch.gather(values, 1, index)


def to_wrist(quat: Tensor, vectors: Tensor) -> Tensor:
    """Rotate world vectors (N, 2, P, 3) into the wrist frames (N, 2, 4)."""
    return quat_rotate_inverse(quat.unsqueeze(-2), vectors)


def proprioception(
    kin: TensorDictBase, joint_pos: Tensor, joint_vel: Tensor, joint_target: Tensor
) -> Tensor:
    """Palm pose, wrist velocity, joints, fingertips, target error; (N, 2, 61 + ...).

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
    tip_vel = to_wrist(quat, kin["tip_linvel"]).flatten(-2) * _LINVEL
    parts = [
        pos,
        quat,
        kin["wrist_linvel"] * _LINVEL,
        kin["wrist_angvel"] * _ANGVEL,
        joint_pos,
        joint_vel * _JOINT_VEL,
        tips,
        tip_vel,
        joint_target - joint_pos,
    ]
    return torch.cat(parts, -1)


def reference_delta(
    kin: TensorDictBase,
    ref: TensorDictBase,
    own_pos: Tensor,
    own_quat: Tensor,
    links: Tensor,
) -> Tensor:
    """Next reference minus robot: mapped links and tips (world), object (wrist).

    Args:
        kin: forward kinematics.
        ref: reference frame shown to the policy.
        own_pos: own object, world, m, (N, 2, 3).
        own_quat: own object, (N, 2, 4).
        links: indices of the mapped links, (2, Q).

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
    quat = kin["wrist_quat"]
    object_pos = quat_rotate_inverse(quat, ref["own_pos"] - own_pos)
    object_quat = _relative_quat(quat, own_quat, ref["own_quat"])
    parts = [
        (ref_pos - robot_pos).flatten(-2),
        (ref_vel - robot_vel).flatten(-2),
        object_pos,
        object_quat,
    ]
    return torch.cat(parts, -1)


def object_state(
    kin: TensorDictBase, own_pos: Tensor, own_quat: Tensor, own_vel: Tensor
) -> Tensor:
    """Own object's pose and velocity in the wrist frame, (N, 2, 13)."""
    quat = kin["wrist_quat"]
    rotation = quat_mul(quat_conj(quat), own_quat)
    parts = [
        quat_rotate_inverse(quat, own_pos - kin["wrist_pos"]),
        _positive(rotation),
        quat_rotate_inverse(quat, own_vel[..., :3]) * _LINVEL,
        quat_rotate_inverse(quat, own_vel[..., 3:]) * _ANGVEL,
    ]
    return torch.cat(parts, -1)


def object_points(
    kin: TensorDictBase,
    ref: TensorDictBase,
    own_pos: Tensor,
    own_quat: Tensor,
    points: Tensor,
) -> Tensor:
    """Eq. (3): surface points now, and their displacement to the next reference.

    Args:
        kin: forward kinematics.
        ref: reference frame shown to the policy.
        own_pos: own object, world, m, (N, 2, 3).
        own_quat: own object, (N, 2, 4).
        points: object frame, m, (N, 2, P, 3).

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


def fingertip_distance(
    kin: TensorDictBase,
    own_pos: Tensor,
    own_quat: Tensor,
    rows: Tensor,
    sdf: SdfGrid,
    tip_radius: Tensor,
) -> tuple[Tensor, Tensor]:
    """Eq. (7): signed distance of palm and fingertips to the own object.

    A fingertip is the sphere at the end of its distal link, so its distance is
    ``SDF(center) - radius``; radius 0 is the paper's point.

    Args:
        kin: forward kinematics.
        own_pos: own object, world, m, (N, 2, 3).
        own_quat: own object, (N, 2, 4).
        rows: object row of each hand, (N, 2).
        sdf: distance grids of all objects.
        tip_radius: m, (2, 5).

    Returns:
        Distances of palm, then tips, m, (N, 2, 6), and surface normals in the wrist
        frame, (N, 2, 6, 3).
    """
    probes = torch.cat([kin["wrist_pos"].unsqueeze(-2), kin["tip_center"]], -2)
    quat = own_quat.unsqueeze(-2)
    local = quat_rotate_inverse(quat, probes - own_pos.unsqueeze(-2))
    distance, normal = sdf.query(local, rows.unsqueeze(-1).expand(local.shape[:-1]))
    palm = torch.zeros_like(tip_radius[:, :1])
    distance = distance - torch.cat([palm, tip_radius], -1)
    return distance, to_wrist(kin["wrist_quat"], quat_rotate(quat, normal))


def tip_distance(
    kin: TensorDictBase,
    own_pos: Tensor,
    own_quat: Tensor,
    rows: Tensor,
    sdf: SdfGrid,
    tip_radius: Tensor,
) -> Tensor:
    """Eq. (7) for the fingertips alone, without normals; (N, 2, 5).

    Arguments are those of ``fingertip_distance``.
    """
    local = kin["tip_center"] - own_pos.unsqueeze(-2)
    local = quat_rotate_inverse(own_quat.unsqueeze(-2), local)
    distance, _ = sdf.query(local, rows.unsqueeze(-1).expand(local.shape[:-1]))
    return distance - tip_radius


def contact(kin: TensorDictBase, code: Tensor) -> Tensor:
    """Contact wrench and point of each link in the wrist frame, (N, 2, 11 L).

    Force and torque about the link origin as (unit vector * log(1 + n), log(1 + n)),
    then the point relative to the palm; zeros without contact.

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


def _relative_quat(wrist: Tensor, current: Tensor, reference: Tensor) -> Tensor:
    """``R_w^T R_ref R_cur^T R_w`` as a quaternion with w >= 0."""
    turn = quat_mul(reference, quat_conj(current))
    return _positive(quat_mul(quat_mul(quat_conj(wrist), turn), wrist))


def _positive(quat: Tensor) -> Tensor:
    return torch.where(quat[..., :1] < 0, -quat, quat)
