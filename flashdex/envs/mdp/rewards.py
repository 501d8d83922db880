"""Rewards: the maths of each with its options, weight and part in the assist's gates.

Every reward is one number per world and hand, (N, 2), from 0 to 1 unless it punishes.
"""

from __future__ import annotations

from collections.abc import Callable, Container

import torch
from torch import Tensor

from flashdex.envs.mdp.step import Step, TermContext
from flashdex.envs.mdp.term import number, reward
from flashdex.envs.transforms.surface_distance import tip_distance
from flashdex.geometry.rotation import quat_angle, quat_to_matrix


def object_points_error(
    # surface points, already scaled to the common radius, object frame, m, (..., P, 3)
    points: Tensor,
    pos: Tensor,  # simulated object position, world, m, (..., 3)
    quat: Tensor,  # simulated object orientation, (..., 4)
    ref_pos: Tensor,  # reference position, (..., 3)
    ref_quat: Tensor,  # reference orientation, (..., 4)
    *,
    top_k: int = 3,  # how many of the largest errors are averaged
) -> Tensor:
    """Eq. (6): mean of the k largest surface-point errors.

    ``e_obj = 1/k sum_{m in J_k} |T_cur p_m - T_ref p_m|``

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


@reward("object_points", weight=1.0, gate="task", needs_object=True)
class ObjectPoints:
    """Eq. (6): exp(-e / sigma), e = mean of the worst points after rescaling.

    Args:
        context: holds the points.
        sigma: Kernel width, m; smaller pays only close tracking.
        rho: Radius to which every object is rescaled, m; 0 keeps the true size.
        top_k: How many of the worst points are averaged; 1 is the strictest.
    """

    def __init__(
        self,
        context: TermContext,
        *,
        sigma: float = number(0.1, above=0, high=1e6),
        rho: float = number(0.058, low=0, high=10),
        top_k: int = number(3, low=1, high=128),
    ) -> None:
        bank = context.bank
        self.points = rescale_points(bank.points, bank.radius, rho=rho)
        self.sigma, self.top_k = sigma, top_k

    def __call__(self, step: Step) -> Tensor:
        """See the class, (N, 2)."""
        error = object_points_error(
            self.points[step.object_row],
            *_object_and_reference(step),
            top_k=self.top_k,
        )
        return exp_kernel(error, sigma=self.sigma)


def _object_and_reference(step: Step) -> tuple[Tensor, ...]:
    return step.own_pos, step.own_quat, step.ref["own_pos"], step.ref["own_quat"]


@reward(
    "object_pose",
    inputs=_object_and_reference,
    gate="task",
    needs_object=True,
    off=True,
)
def object_pose_exp(
    pos: Tensor,
    quat: Tensor,
    ref_pos: Tensor,
    ref_quat: Tensor,
    *,
    beta_pos: float = number(10.0, above=0, high=1e6),
    beta_rot: float = number(1.0, above=0, high=1e6),
) -> Tensor:
    """DexMachina's object term exp(-b_p d) exp(-b_r angle), off by default.

    It replaces the point term in the paper's ablation "w/o PCD matching".

    Args:
        pos: object, world, m, (..., 3).
        quat: (..., 4).
        ref_pos: its reference, (..., 3).
        ref_quat: (..., 4).
        beta_pos: b_p, 1/m.
        beta_rot: b_r, 1/rad.
    """
    distance = (pos - ref_pos).norm(dim=-1)
    return torch.exp(-beta_pos * distance - beta_rot * quat_angle(quat, ref_quat))


def _tip_distances(step: Step) -> tuple[Tensor, Tensor]:
    own = step.own_pos, step.own_quat, step.object_row
    radius = step.context.tip_radius
    return tip_distance(step.kin, *own, step.bank.sdf, radius), step.ref["tip_dist"]


@reward("fingertip_distance", weight=0.3, inputs=_tip_distances, needs_object=True)
def fingertip_distance_exp(
    dist: Tensor, ref_dist: Tensor, *, sigma: float = number(0.01, above=0, high=1e6)
) -> Tensor:
    """Eq. (8): mean over tips of exp(-max(0, d - d_ref) / sigma).

    Args:
        dist: signed distance of the robot fingertips to the object, m, (..., 5).
        ref_dist: unsigned distance of the human fingertips, m, (..., 5).
        sigma: Kernel width, m.
    """
    return torch.exp(-(dist - ref_dist).clamp_min(0) / sigma).mean(-1)


def _both(name: str) -> Callable[[Step], tuple[Tensor, Tensor]]:
    """A quantity of the robot hand and of the human one."""
    return lambda step: (step.kin[name], step.ref[name])


@reward("wrist_pos", weight=0.15, inputs=_both("wrist_pos"), gate="imitation")
def wrist_pos_error_exp(
    pos: Tensor, ref_pos: Tensor, *, scale: float = number(10.0, above=0, high=1e6)
) -> Tensor:
    """exp(-scale d), d to the human wrist, m.

    Args:
        pos: wrist, world, m, (..., 3).
        ref_pos: human wrist, (..., 3).
        scale: Steepness, 1/m.
    """
    return torch.exp(-scale * (pos - ref_pos).norm(dim=-1))


@reward("wrist_rot", weight=0.15, inputs=_both("wrist_quat"), gate="imitation")
def wrist_rot_error_exp(
    quat: Tensor, ref_quat: Tensor, *, scale: float = number(3.0, above=0, high=1e6)
) -> Tensor:
    """exp(-scale angle) to the wanted wrist orientation, rad.

    Args:
        quat: wrist, (..., 4).
        ref_quat: wanted, (..., 4).
        scale: Steepness, 1/rad.
    """
    return torch.exp(-scale * quat_angle(quat, ref_quat))


@reward("fingertip_pos", weight=0.3, inputs=_both("tip_pos"), gate="imitation")
def fingertip_pos_error_exp(
    pos: Tensor, ref_pos: Tensor, *, scale: float = number(20.0, above=0, high=1e6)
) -> Tensor:
    """Mean over tips of exp(-scale d) to the human tips, m.

    Args:
        pos: fingertips, world, m, (..., 5, 3).
        ref_pos: human tips, (..., 5, 3).
        scale: Steepness, 1/m.
    """
    return torch.exp(-scale * (pos - ref_pos).norm(dim=-1)).mean(-1)


def _target_and_reference(step: Step) -> tuple[Tensor, Tensor, Tensor]:
    lower, upper = step.context.joint_range.unbind(-1)
    return step.target, step.ref["joint_target"], upper - lower


@reward("behaviour_cloning", weight=0.3, inputs=_target_and_reference, gate="cloning")
def behaviour_cloning_exp(
    target: Tensor,
    ref_joint_pos: Tensor,
    joint_range: Tensor,
    *,
    scale: float = number(500.0, above=0, high=1e6),
) -> Tensor:
    """Mean over joints of exp(-scale (target - ref)^2 / (2 range)).

    It compares the position target, not the position, with the kinematic retarget.

    Args:
        target: position targets after filter and clamp, (..., J).
        ref_joint_pos: retargeted joint positions, (..., J).
        joint_range: upper minus lower limit, (..., J).
        scale: Steepness, 1/rad; wrist joints have wide ranges, so there it is nearly
            flat.
    """
    error = 0.5 * (target - ref_joint_pos).square() / joint_range
    return torch.exp(-scale * error).mean(-1)


@reward(
    "action_l2",
    weight=number(-0.01, low=-1e6, high=0),
    inputs=lambda step: (step.action,),
)
def action_l2(action: Tensor) -> Tensor:
    """Mean square of the raw action.

    Args:
        action: (..., J).
        weight: Listed weight; larger in size gives smoother and weaker motions.
    """
    return action.square().mean(-1)


@reward(
    "failure",
    weight=number(-100.0, low=-1e6, high=0),
    inputs=lambda step: (step.failed,),
    on_failure=True,
)
def failure(failed: Tensor) -> Tensor:
    """Paid once by the blamed hands in the step that terminates by failure.

    Args:
        failed: (N, 2) bool.
        weight: Whole weight (not halved); times 1/60 s it is -1.67.
    """
    return failed.float()


def weighted_sum(
    terms: dict[str, Tensor],  # values of each term, (N, 2)
    weights: dict[str, float],  # listed weights by term name
    *,
    step_dt: float,  # control step, s
    whole: Container[str] = ("failure",),  # terms whose weight is not halved
) -> Tensor:
    """Eq. (5) as released: ``r_h = dt sum_i w_i term_i``.

    Each hand gets half of every weight but those of failures, so that two hands add up
    to the listed value; a failure is charged in full to the hand that caused it.
    """
    total = torch.zeros_like(next(iter(terms.values())))
    for name, value in terms.items():
        share = 1.0 if name in whole else 0.5
        total = total + share * weights[name] * value
    return step_dt * total
