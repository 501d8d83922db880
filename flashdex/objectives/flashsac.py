"""FlashSAC over groups: one actor and one categorical twin critic per group."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn
from torchrl.objectives import LossModule

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.squash import sample_squashed, target_entropy
from flashdex.objectives.batch import (
    FlashBatch,
    masked_mean,
    nested,
    read_pair,
    stack_groups,
)
from flashdex.objectives.categorical import categorical_projection
from flashdex.objectives.reward_normalizer import RewardNormalizer

Metrics = dict[str, Tensor]


class FlashSACLoss(LossModule):
    """Losses of FlashSAC; they are to be called one after the other by a stepper.

    ``actor_loss``, ``alpha_loss``, ``qvalue_loss`` form one update in this order: the
    critic target must see the stepped actor and temperature. ``forward`` exists for the
    TorchRL interface and evaluates all three at the same parameters.

    With one group this is plain FlashSAC. With several, every actor reads the full
    observation, every critic the joint action, and the actor loss of a group reaches
    its critic only through that group's own action. Reductions over groups: sum in the
    actor and temperature losses, mean in the critic loss.

    Args:
        actor_network: towers of all groups.
        qvalue_network: critics of all groups.
        groups: group names in tower order; None reads root ``action`` and ``reward``.
        gamma: one-step discount.
        n_steps: window length of rows without a ``steps`` entry.
        alpha_init: initial temperature of every group.
        target_sigma: sigma of the target entropy per action dimension.
        reward_normalizer: divides the rewards at sampling; None leaves them raw.
        exact_discount: gamma^k of the true window; False is the published gamma^n.

    Example:
        >>> actor, critic = FlashActor(9, 4, width=16), EnsembleCritic(9, 4, width=16)
        >>> loss = FlashSACLoss(actor, critic, gamma=0.99)
    """

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "observation"
        future: NestedKey = "future"
        action: NestedKey = "action"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        steps: NestedKey = "steps"
        group_mask: NestedKey = "group_mask"

    default_keys = _AcceptedKeys
    out_keys = ("loss_actor", "loss_alpha", "loss_qvalue")

    def __init__(
        self,
        actor_network: FlashActor,
        qvalue_network: EnsembleCritic,
        *,
        groups: Sequence[str] | None = None,
        gamma: float = 0.98,
        n_steps: int = 1,
        alpha_init: float = 0.01,
        target_sigma: float = 0.15,
        reward_normalizer: RewardNormalizer | None = None,
        exact_discount: bool = True,
    ) -> None:
        super().__init__()
        self.groups: tuple[str | None, ...] = (None,) if groups is None else (*groups,)
        if (
            not len(self.groups)
            == actor_network.num_groups
            == qvalue_network.num_groups
        ):
            raise ValueError(
                f"{len(self.groups)} groups {self.groups}, {actor_network.num_groups} "
                f"actor towers and {qvalue_network.num_groups} critic groups do not "
                "match; build the networks with num_groups equal to the groups."
            )
        self.actor_network = actor_network
        self.qvalue_network = qvalue_network
        self.target_qvalue_network = copy.deepcopy(qvalue_network).requires_grad_(False)
        self.reward_normalizer = reward_normalizer
        self.gamma, self.n_steps, self.exact_discount = gamma, n_steps, exact_discount
        self.log_alpha = nn.Parameter(
            torch.full((len(self.groups),), float(alpha_init)).log()
        )
        self.target_entropy = target_entropy(actor_network.action_dim, target_sigma)

    @property
    def functional(self) -> bool:
        """False: the networks are plain submodules with a mode argument."""
        return False

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """The categorical backup is the target; there is no value estimator."""

    def named_parameters(
        self, prefix: str = "", recurse: bool = True, remove_duplicate: bool = True
    ) -> Iterator[tuple[str, nn.Parameter]]:
        """Trained parameters; those of the target are left out."""
        for name, parameter in nn.Module.named_parameters(
            self, prefix, recurse, remove_duplicate
        ):
            if "target_qvalue_network" not in name:
                yield name, parameter

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that every batch must hold."""
        keys = self.tensor_keys
        names = [
            keys.observation,
            ("next", keys.observation),
            ("next", keys.terminated),
        ]
        if self.actor_network.future_encoder is not None:
            names += [keys.future, ("next", keys.future)]
        for group in self.groups:
            names.append(nested(group, keys.action))
            names.append(nested("next", nested(group, keys.reward)))
        return names

    # -- from TensorDict to tensors -------------------------------------------

    @torch.no_grad()
    def read(self, tensordict: TensorDictBase) -> FlashBatch:
        """Stack the groups of a sampled batch and scale its rewards."""
        keys, following = self.tensor_keys, tensordict.get("next")
        encoders = (
            self.actor_network.future_encoder,
            self.qvalue_network.future_encoder,
        )
        future = None
        if any(encoder is not None for encoder in encoders):
            future = read_pair(tensordict, keys.future)
        reward = stack_groups(following, self.groups, keys.reward)
        if self.reward_normalizer is not None:
            reward = reward / self.reward_normalizer.denominator().to(reward.dtype)
        terminated = following.get(keys.terminated).reshape(-1).to(reward.dtype)
        steps = tensordict.get(keys.steps, None) if self.exact_discount else None
        if steps is None:
            discount = torch.full_like(terminated, self.gamma**self.n_steps)
        else:
            discount = self.gamma ** steps.reshape(-1).to(reward.dtype)
        mask = tensordict.get(keys.group_mask, None)
        return FlashBatch(
            observation=read_pair(tensordict, keys.observation),
            future=future,
            action=stack_groups(tensordict, self.groups, keys.action),
            reward=reward.mT,
            discount=discount,
            terminated=terminated,
            weight=None if mask is None else mask.mT.to(reward.dtype),
        )

    # -- the three pieces ------------------------------------------------------

    def actor_loss(
        self, tensordict: TensorDictBase, *, noise: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """``sum_g mean_B [alpha_g log pi_g - min_m Q_gm(s, [a_g, sg(a_other)])]``.

        Args:
            tensordict: sampled batch.
            noise: standard normal draws (G, B, A); default fresh ones.

        Returns:
            Loss () and per-group ``loss_actor``, ``entropy``, ``q_value`` (G,) as well
            as ``log_prob`` (G, B), detached.
        """
        return self.actor_objective(
            self.read(tensordict), self._noise(tensordict, noise)
        )

    def alpha_loss(
        self, log_prob: Tensor, weight: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """``sum_g alpha_g (H_g - H_target)`` with ``H_g = -mean_B log pi_g``.

        Args:
            log_prob: of the actor loss, (G, B).
            weight: entries that count, (G, B), or None.
        """
        entropy = -masked_mean(log_prob.detach(), weight)
        excess = entropy - self.target_entropy
        if weight is not None:
            excess = torch.where(weight.sum(-1) > 0, excess, 0.0)
        alpha = self.log_alpha.exp()
        loss = alpha * excess
        return loss.sum(), {"loss_alpha": loss.detach(), "alpha": alpha.detach()}

    def qvalue_loss(
        self, tensordict: TensorDictBase, *, noise: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """Cross-entropy to the projected target, mean over groups, members and batch.

        Args:
            tensordict: sampled batch.
            noise: standard normal draws (G, B, A) of the next action.

        Returns:
            Loss () and per-group ``loss_qvalue``, ``td_error``, ``clip_fraction`` (G,).
        """
        noise = self._noise(tensordict, noise)
        return self.qvalue_objective(self.read(tensordict), noise)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All losses at the present parameters (interface only, see the class)."""
        actor, actor_metrics = self.actor_loss(tensordict)
        mask = tensordict.get(self.tensor_keys.group_mask, None)
        weight = None if mask is None else mask.mT.to(actor.dtype)
        alpha, alpha_metrics = self.alpha_loss(actor_metrics["log_prob"], weight)
        qvalue, _ = self.qvalue_loss(tensordict)
        return TensorDict(
            {
                "loss_actor": actor,
                "loss_alpha": alpha,
                "loss_qvalue": qvalue,
                "alpha": alpha_metrics["alpha"].mean(),
                "entropy": actor_metrics["entropy"].mean(),
            }
        )

    # -- pure tensor objectives (what a compiler sees) -------------------------

    def actor_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """`actor_loss` on tensors; ``noise`` is (G, B, A)."""
        first = slice(0, batch.size)
        # both halves of the batch enter the statistics, only the first the loss
        mean, std = self.actor_network(
            batch.observation, batch.future, mode="train", keep=first
        )
        action, log_prob = sample_squashed(mean, std, noise)
        observation, _, future, _ = batch.split()
        log_p = self.qvalue_network(
            observation, self._own_action_views(action), future, mode="frozen"
        )
        value = self.qvalue_network.expected_value(log_p).amin(1)
        alpha = self.log_alpha.detach().exp()[:, None]
        loss = masked_mean(alpha * log_prob - value, batch.weight)
        metrics = {
            "loss_actor": loss.detach(),
            "entropy": -masked_mean(log_prob.detach(), batch.weight),
            "q_value": masked_mean(value.detach(), batch.weight),
            "log_prob": log_prob.detach(),
        }
        return loss.sum(), metrics

    def qvalue_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """`qvalue_loss` on tensors; ``noise`` is (G, B, A)."""
        size = batch.size
        target, joint, metrics = self._target(batch, noise)
        log_p = self.qvalue_network(
            batch.observation, joint, batch.future, mode="train", keep=slice(0, size)
        )
        cross_entropy = -(target[:, None] * log_p).sum(-1)
        weight = None if batch.weight is None else batch.weight[:, None]
        per_member = masked_mean(cross_entropy, weight)
        with torch.no_grad():
            critic = self.qvalue_network
            error = target @ critic.atoms - critic.expected_value(log_p).mean(1)
            metrics["td_error"] = masked_mean(error.abs(), batch.weight)
            metrics["loss_qvalue"] = per_member.mean(1)
        return per_member.mean(), metrics

    @torch.no_grad()
    def _target(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Tensor, Metrics]:
        """Target distribution (G, B, Z), joint actions (2B, G A) and metrics."""
        _, after, _, next_future = batch.split()
        mean, std = self.actor_network(after, next_future, mode="eval")
        next_action, log_prob = sample_squashed(mean, std, noise)
        joint = torch.cat([batch.action, _side_by_side(next_action)])
        critic = self.target_qvalue_network
        log_p = critic(
            batch.observation,
            joint,
            batch.future,
            mode="train",
            keep=slice(batch.size, 2 * batch.size),
        )
        worst = critic.expected_value(log_p).argmin(1)  # over members, never groups
        index = worst[:, None, :, None].expand(-1, 1, -1, critic.num_atoms)
        prob = log_p.gather(1, index).squeeze(1).exp()
        entropy_cost = self.log_alpha.exp()[:, None] * log_prob
        target = categorical_projection(
            prob,
            reward=batch.reward,
            discount=batch.discount,
            terminated=batch.terminated,
            entropy_cost=entropy_cost,
            v_max=critic.v_max,
        )
        ends = target[..., 0] + target[..., -1]
        return target, joint, {"clip_fraction": masked_mean(ends, batch.weight)}

    def _own_action_views(self, action: Tensor) -> Tensor:
        """Joint action once per group; only its own part carries gradient.

        Args:
            action: fresh samples (G, B, A).

        Returns:
            (B, A) for one group, else (G, B, G A).
        """
        joint = _side_by_side(action)
        groups, _, width = action.shape
        if groups == 1:
            return joint
        own = torch.eye(groups, dtype=torch.bool, device=action.device)
        own = own.repeat_interleave(width, 1)[:, None]
        return torch.where(own, joint, joint.detach())

    def _noise(self, tensordict: TensorDictBase, noise: Tensor | None) -> Tensor:
        if noise is not None:
            return noise
        action = tensordict.get(nested(self.groups[0], self.tensor_keys.action))
        shape = (len(self.groups), action.shape[0], self.actor_network.action_dim)
        return torch.randn(shape, dtype=action.dtype, device=action.device)


def _side_by_side(action: Tensor) -> Tensor:
    """(G, B, A) to (B, G A)."""
    return action.transpose(0, 1).flatten(1)
