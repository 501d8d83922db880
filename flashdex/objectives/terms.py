"""The FlashSAC objectives on plain tensors: what a compiler sees.

Each network is called with an explicit BatchNorm mode:

==============  ==============  ===========  ===========================
objective       network         mode         rows fed
==============  ==============  ===========  ===========================
actor           actor           train        s and s', first half kept
actor           critic          frozen       s with fresh actions
target          actor           eval         s'
target          target critic   train        both, second half kept
critic          critic          train        both, first half kept
==============  ==============  ===========  ===========================
"""

from __future__ import annotations

import torch
from torch import Tensor

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.policy import sample_squashed
from flashdex.objectives.batch import FlashBatch, masked_mean


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
        reward: scaled reward (n-step sum), (...).
        discount: gamma^k of the true window, (...).
        terminated: 1 where the window ends in a true termination, (...).
        entropy_cost: ``alpha log pi(a' | s')``, (...).
        v_max: end of the support.

    Returns:
        (..., Z), same total mass as ``prob``.
    """
    last = prob.shape[-1] - 1
    spacing = 2.0 * v_max / last
    atoms = torch.linspace(
        -v_max, v_max, last + 1, dtype=prob.dtype, device=prob.device
    )
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


Metrics = dict[str, Tensor]


def actor_objective(
    actor: FlashActor,
    critic: EnsembleCritic,
    log_alpha: Tensor,
    batch: FlashBatch,
    noise: Tensor,
    *,
    own_action_gate: bool = True,
) -> tuple[Tensor, Metrics]:
    """``sum_g mean_B [alpha_g log pi_g - min_m Q_gm(s, [a_g, sg(a_other)])]``.

    Args:
        actor: towers.
        critic: online critics; they receive no gradient.
        log_alpha: log temperatures, (G,); they receive no gradient.
        batch: sampled transitions.
        noise: standard normal draws, (G, B, A).
        own_action_gate: False drops the stop-gradient ``sg``, so that every tower
            climbs the sum of all groups' values.

    Returns:
        Loss (), and detached metrics: ``log_prob`` (G, B), all others (G,).
    """
    observation, _, future, _ = batch.split()
    # both halves of the batch enter the statistics, only the first the loss
    mean, std = actor(
        batch.observation, batch.future, mode="train", keep=slice(0, batch.size)
    )
    action, log_prob = sample_squashed(mean, std, noise)
    joint = own_action_views(action) if own_action_gate else side_by_side(action)
    log_p = critic(observation, joint, future, mode="frozen")
    value = critic.expected_value(log_p).amin(1)
    alpha = log_alpha.detach().exp()[:, None]
    loss = masked_mean(alpha * log_prob - value, batch.weight)
    metrics = {
        "loss_actor": loss.detach(),
        "entropy": -masked_mean(log_prob.detach(), batch.weight),
        "q_value": masked_mean(value.detach(), batch.weight),
        "log_prob": log_prob.detach(),
    }
    return loss.sum(), metrics


def alpha_objective(
    log_alpha: Tensor,
    log_prob: Tensor,
    weight: Tensor | None,
    *,
    target_entropy: float,
) -> tuple[Tensor, Metrics]:
    """``sum_g alpha_g (H_g - H_target)`` with ``H_g = -mean_B log pi_g``.

    Args:
        log_alpha: log temperatures, (G,).
        log_prob: densities of the actor objective, (G, B).
        weight: 1 where a group takes part, (G, B), or None.
        target_entropy: of the policy of one group.

    Returns:
        Loss (), and detached metrics (G,).
    """
    excess = -masked_mean(log_prob.detach(), weight) - target_entropy
    if weight is not None:
        excess = torch.where(weight.sum(-1) > 0, excess, 0.0)
    alpha = log_alpha.exp()
    loss = alpha * excess
    return loss.sum(), {"loss_alpha": loss.detach(), "alpha": alpha.detach()}


@torch.no_grad()
def backup(
    actor: FlashActor,
    target_critic: EnsembleCritic,
    log_alpha: Tensor,
    batch: FlashBatch,
    noise: Tensor,
) -> tuple[Tensor, Tensor]:
    """Categorical target of every group and the actions it was computed with.

    A group bootstraps with its own entropy, at the joint next action of all towers; the
    least member is chosen by its expected value and its whole distribution is used.

    Returns:
        Target distributions (G, B, Z) and joint actions at s and s' (2B, G A).
    """
    _, after, _, next_future = batch.split()
    mean, std = actor(after, next_future, mode="eval")
    next_action, log_prob = sample_squashed(mean, std, noise)
    joint = torch.cat([batch.action, side_by_side(next_action)])
    log_p = target_critic(
        batch.observation,
        joint,
        batch.future,
        mode="train",
        keep=slice(batch.size, 2 * batch.size),
    )
    least = target_critic.expected_value(log_p).argmin(1)  # members, never groups
    index = least[:, None, :, None].expand(-1, 1, -1, target_critic.num_atoms)
    target = categorical_projection(
        log_p.gather(1, index).squeeze(1).exp(),
        reward=batch.reward,
        discount=batch.discount,
        terminated=batch.terminated,
        entropy_cost=log_alpha.exp()[:, None] * log_prob,
        v_max=target_critic.v_max,
    )
    return target, joint


def qvalue_objective(
    actor: FlashActor,
    critic: EnsembleCritic,
    target_critic: EnsembleCritic,
    log_alpha: Tensor,
    batch: FlashBatch,
    noise: Tensor,
) -> tuple[Tensor, Metrics]:
    """``-sum_z m(z) log p(z | s, a)``, mean over groups, members and valid rows.

    Args:
        actor: towers, already stepped in this update.
        critic: online critics.
        target_critic: slow copy with statistics of its own.
        log_alpha: log temperatures, already stepped, (G,).
        batch: sampled transitions.
        noise: standard normal draws of the next action, (G, B, A).

    Returns:
        Loss (), and detached metrics (G,).
    """
    target, joint = backup(actor, target_critic, log_alpha, batch, noise)
    log_p = critic(
        batch.observation, joint, batch.future, mode="train", keep=slice(0, batch.size)
    )
    cross_entropy = -(target[:, None] * log_p).sum(-1)
    weight = None if batch.weight is None else batch.weight[:, None]
    per_member = masked_mean(cross_entropy, weight)
    with torch.no_grad():
        error = target @ critic.atoms - critic.expected_value(log_p).mean(1)
        ends = target[..., 0] + target[..., -1]
        metrics = {
            "loss_qvalue": per_member.mean(1),
            "td_error": masked_mean(error.abs(), batch.weight),
            "clip_fraction": masked_mean(ends, batch.weight),
        }
    return per_member.mean(), metrics


def own_action_views(action: Tensor) -> Tensor:
    """Joint action once per group; only the group's own part carries gradient.

    Args:
        action: fresh samples, (G, B, A).

    Returns:
        (B, A) for one group, else (G, B, G A).
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
