"""Reward terms as pure functions; weights and kernel widths come from the recipe.

Every term returns one number per world and hand, (N, 2). The weighted sum of
method section 9 is formed in ``weighted_sum``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flashdex.geometry.rotation import quat_angle, quat_to_matrix


def object_points_error(
    points: Tensor,
    pos: Tensor,
    quat: Tensor,
    ref_pos: Tensor,
    ref_quat: Tensor,
    *,
    top_k: int = 3,
) -> Tensor:
    """Eq. (6): mean of the k largest surface-point errors.

    ``e_obj = 1/k sum_{m in J_k} |T_cur p_m - T_ref p_m|``

    Args:
        points: surface points, already scaled to the common radius, object
            frame, m, (..., P, 3).
        pos: simulated object position, world, m, (..., 3).
        quat: simulated object orientation, (..., 4).
        ref_pos: reference position, (..., 3).
        ref_quat: reference orientation, (..., 4).
        top_k: how many of the largest errors are averaged.

    Returns:
        Error in metres, (...).
    """
    # (R p + t) - (R_ref p + t_ref) = (R - R_ref) p + (t - t_ref): one product, not two
    turn = quat_to_matrix(quat) - quat_to_matrix(ref_quat)
    shift = (pos - ref_pos).unsqueeze(-2)
    error = (points @ turn.mT + shift).norm(dim=-1)
    return error.topk(min(top_k, error.shape[-1]), dim=-1).values.mean(-1)


def rescale_points(points: Tensor, radius: Tensor, *, rho: float) -> Tensor:
    """Eq. (6): ``p~_m = rho p_m / max_n |p_n|``; ``rho <= 0`` keeps the size.

    Args:
        points: surface points, object frame, m, (..., P, 3).
        radius: largest distance of a point from the object-frame origin, (...).
        rho: common radius, m. 0.058 makes a 30 degree turn cost 3 cm.
    """
    if rho <= 0:
        return points
    return points * (rho / radius.clamp_min(1e-6))[..., None, None]


def exp_kernel(error: Tensor, *, sigma: float) -> Tensor:
    """``exp(-e / sigma)``, the kernel of Eqs. (6) and (8)."""
    return torch.exp(-error / sigma)


def object_pose_exp(
    pos: Tensor,
    quat: Tensor,
    ref_pos: Tensor,
    ref_quat: Tensor,
    *,
    beta_pos: float = 10.0,
    beta_rot: float = 1.0,
) -> Tensor:
    """DexMachina's object term, ``exp(-b_p d) exp(-b_r angle)``, (...).

    It replaces the point term in the paper's ablation "w/o PCD matching".
    """
    distance = (pos - ref_pos).norm(dim=-1)
    return torch.exp(-beta_pos * distance - beta_rot * quat_angle(quat, ref_quat))


def fingertip_distance_exp(dist: Tensor, ref_dist: Tensor, *, sigma: float) -> Tensor:
    """Eq. (8): ``mean_f exp(-max(0, d_f - d_ref_f) / sigma_int)``.

    Args:
        dist: signed distance of the robot fingertips to the object, m, (..., 5).
        ref_dist: unsigned distance of the human fingertips, m, (..., 5).
        sigma: kernel width, m.
    """
    return torch.exp(-(dist - ref_dist).clamp_min(0) / sigma).mean(-1)


def wrist_pos_error_exp(pos: Tensor, ref_pos: Tensor, *, scale: float) -> Tensor:
    """``exp(-scale |p - p_ref|)`` of the wrist, m, (..., 3) to (...)."""
    return torch.exp(-scale * (pos - ref_pos).norm(dim=-1))


def wrist_rot_error_exp(quat: Tensor, ref_quat: Tensor, *, scale: float) -> Tensor:
    """``exp(-scale angle)`` of the wrist orientation, rad, (..., 4) to (...)."""
    return torch.exp(-scale * quat_angle(quat, ref_quat))


def fingertip_pos_error_exp(pos: Tensor, ref_pos: Tensor, *, scale: float) -> Tensor:
    """``mean_f exp(-scale |x_f - x_ref_f|)``, world, m, (..., 5, 3) to (...)."""
    return torch.exp(-scale * (pos - ref_pos).norm(dim=-1)).mean(-1)


def behaviour_cloning_exp(
    target: Tensor, ref_joint_pos: Tensor, joint_range: Tensor, *, scale: float
) -> Tensor:
    """``mean_j exp(-scale 0.5 (q*_j - q_ref_j)^2 / range_j)``.

    It compares the position target, not the position, with the kinematic retarget.

    Args:
        target: position targets after filter and clamp, (..., J).
        ref_joint_pos: retargeted joint positions, (..., J).
        joint_range: upper minus lower limit, (..., J).
        scale: 500 in the released code.
    """
    error = 0.5 * (target - ref_joint_pos).square() / joint_range
    return torch.exp(-scale * error).mean(-1)


def action_l2(action: Tensor) -> Tensor:
    """``mean a^2`` of the raw action, (..., J) to (...)."""
    return action.square().mean(-1)


def weighted_sum(
    terms: dict[str, Tensor], weights: dict[str, float], *, step_dt: float
) -> Tensor:
    """Eq. (5) as released: ``r_h = dt sum_i w_i term_i``.

    Each hand gets half of every weight but the failure's, so that two hands add up
    to the listed value; a failure is charged in full to the hand that caused it.

    Args:
        terms: values of each term, (N, 2).
        weights: listed weights by term name.
        step_dt: control step, s.
    """
    total = torch.zeros_like(next(iter(terms.values())))
    for name, value in terms.items():
        share = 1.0 if name == "failure" else 0.5
        total = total + share * weights[name] * value
    return step_dt * total
