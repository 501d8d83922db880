"""Pure functions of the FlashSAC objectives: the moved distribution, joint actions."""

from __future__ import annotations

import torch
from torch import Tensor


def categorical_projection(
    prob: Tensor,
    *,
    reward: Tensor,
    discount: Tensor,
    terminated: Tensor,
    entropy_cost: Tensor,
    v_max: float,
) -> Tensor:
    """Target distribution on the fixed atoms ``z = linspace(-v_max, v_max, Z)``.

    ``Tz = clip(r + discount (z - alpha log pi)(1 - terminated), -v_max, v_max)``; the
    mass of each moved atom is split linearly between its two neighbours.

    Args:
        prob: distribution of the next state-action pair, (..., Z).
        reward: scaled reward (n-step sum), (...), as all that follow.
        discount: gamma^k of the true window.
        terminated: 1 where the window ends in a true termination.
        entropy_cost: ``alpha log pi(a' | s')``.
        v_max: end of the support.

    Returns:
        (..., Z), same total mass as ``prob``.
    """
    last = prob.shape[-1] - 1
    spacing = 2.0 * v_max / last
    like = {"dtype": prob.dtype, "device": prob.device}
    atoms = torch.linspace(-v_max, v_max, last + 1, **like)
    carry = (discount * (1.0 - terminated)).unsqueeze(-1)
    moved = reward.unsqueeze(-1) + carry * (atoms - entropy_cost.unsqueeze(-1))
    position = (moved.clamp(-v_max, v_max) + v_max) / spacing
    # rounding of the division must not leave the support
    position = position.clamp(0.0, float(last))
    lower = position.floor()
    upper_share = position - lower
    # NaN as an index would end a device's context; the gradient shows it anyway
    index = lower.long().clamp(0, last)
    target = torch.zeros_like(prob)
    target.scatter_add_(-1, index, prob * (1.0 - upper_share))
    target.scatter_add_(-1, (index + 1).clamp_max(last), prob * upper_share)
    return target


def own_action_views(action: Tensor) -> Tensor:
    """Joint action once per group; only the group's own part carries gradient.

    From fresh samples (G, B, A) to (B, A) for one group, else (G, B, G A).
    """
    joint = side_by_side(action)
    groups, _, width = action.shape
    if groups == 1:
        return joint
    own = torch.eye(groups, dtype=torch.bool, device=action.device)
    own = own.repeat_interleave(width, 1)[:, None]
    return torch.where(own, joint, joint.detach())


def side_by_side(action: Tensor) -> Tensor:
    """(G, B, A) to (B, G A)."""
    return action.transpose(0, 1).flatten(1)
