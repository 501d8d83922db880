"""FlashSAC over groups: one actor and one categorical twin critic per group.

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
from flashdex.modules.policy import sample_squashed, target_entropy
from flashdex.objectives.batch import (
    FlashBatch,
    masked_mean,
    nested,
    read_pair,
    read_windows,
    stack_groups,
)
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.terms import (
    categorical_projection,
    own_action_views,
    side_by_side,
)

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
        own_action_gate: a group's actor loss differentiates its critic with respect to
            its own action only; False lets the other towers follow that critic too.

    Example:
        >>> actor, critic = FlashActor(9, 4, width=16), EnsembleCritic(9, 4, width=16)
        >>> loss = FlashSACLoss(actor, critic, gamma=0.99)
    """

    @dataclass
    class _AcceptedKeys(LossModule._AcceptedKeys):
        observation: NestedKey = "observation"
        future: NestedKey = "future"
        action: NestedKey = "action"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        steps: NestedKey = "steps"
        group_mask: NestedKey = "group_mask"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys  # pyright: ignore[reportIncompatibleMethodOverride]

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
        own_action_gate: bool = True,
    ) -> None:
        super().__init__()
        self.out_keys = ["loss_actor", "loss_alpha", "loss_qvalue"]
        self.groups: tuple[str | None, ...] = (None,) if groups is None else (*groups,)
        counts = {actor_network.num_groups, qvalue_network.num_groups}
        if counts != {len(self.groups)}:
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
        self.own_action_gate = own_action_gate
        alpha = torch.full((len(self.groups),), float(alpha_init))
        self.log_alpha = nn.Parameter(alpha.log())
        encoders = (actor_network.future_encoder, qvalue_network.future_encoder)
        self._reads_future = any(encoder is not None for encoder in encoders)
        self.target_entropy = target_entropy(actor_network.action_dim, target_sigma)

    @property
    def functional(self) -> bool:  # pyright: ignore[reportIncompatibleMethodOverride]
        """False: the networks are plain submodules with a mode argument."""
        return False

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """The categorical backup is the target; there is no value estimator."""

    def named_parameters(
        self, prefix: str = "", recurse: bool = True, remove_duplicate: bool = True
    ) -> Iterator[tuple[str, nn.Parameter]]:
        """Trained parameters; those of the target are left out."""
        options = (prefix, recurse, remove_duplicate)
        for name, parameter in nn.Module.named_parameters(self, *options):
            if "target_qvalue_network" not in name:
                yield name, parameter

    @property
    def in_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Entries that every batch must hold."""
        keys = self.tensor_keys
        names = [keys.observation, nested("next", keys.observation)]
        names.append(nested("next", keys.terminated))
        if self._reads_future:
            names += [keys.future, nested("next", keys.future)]
        for group in self.groups:
            names.append(nested(group, keys.action))
            names.append(nested("next", nested(group, keys.reward)))
        return names

    @torch.no_grad()
    def read(self, tensordict: TensorDictBase) -> FlashBatch:
        """Stack the groups of a sampled batch and scale its rewards."""
        keys, following = self.tensor_keys, tensordict.get("next")
        future = read_windows(tensordict, keys.future) if self._reads_future else None
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

    def actor_loss(
        self, tensordict: TensorDictBase, *, noise: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """`actor_objective` of a sampled batch; the noise is drawn where not given."""
        noise = self._noise(tensordict, noise)
        return self.actor_objective(self.read(tensordict), noise)

    def qvalue_loss(
        self, tensordict: TensorDictBase, *, noise: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """`qvalue_objective` of a sampled batch; the noise is drawn where not given."""
        noise = self._noise(tensordict, noise)
        return self.qvalue_objective(self.read(tensordict), noise)

    @dispatch()
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

    def _noise(self, tensordict: TensorDictBase, noise: Tensor | None) -> Tensor:
        if noise is not None:
            return noise
        action = tensordict.get(nested(self.groups[0], self.tensor_keys.action))
        shape = (len(self.groups), action.shape[0], self.actor_network.action_dim)
        return torch.randn(shape, dtype=action.dtype, device=action.device)

    # -- on plain tensors: what a compiler sees ---------------------------------

    def actor_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """``sum_g mean_B [alpha_g log pi_g - min_m Q_gm(s, [a_g, sg(a_other)])]``.

        Critics and temperatures receive no gradient.

        Args:
            batch: sampled transitions.
            noise: standard normal draws, (G, B, A).

        Returns:
            Loss () and detached ``loss_actor``, ``entropy``, ``q_value`` (G,) as well
            as ``log_prob`` (G, B).
        """
        observation, _, future, _ = batch.split()
        # both halves of the batch enter the statistics, only the first the loss
        mean, std = self.actor_network(
            batch.observation, batch.future, mode="train", keep=slice(0, batch.size)
        )
        action, log_prob = sample_squashed(mean, std, noise)
        views = own_action_views if self.own_action_gate else side_by_side
        log_p = self.qvalue_network(observation, views(action), future, mode="frozen")
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

    def alpha_loss(
        self, log_prob: Tensor, weight: Tensor | None = None
    ) -> tuple[Tensor, Metrics]:
        """``sum_g alpha_g (H_g - H_target)`` with ``H_g = -mean_B log pi_g``.

        Args:
            log_prob: of the actor loss, (G, B).
            weight: 1 where a group takes part, (G, B), or None.

        Returns:
            Loss (), and detached metrics (G,).
        """
        excess = -masked_mean(log_prob.detach(), weight) - self.target_entropy
        if weight is not None:
            excess = torch.where(weight.sum(-1) > 0, excess, 0.0)
        alpha = self.log_alpha.exp()
        loss = alpha * excess
        return loss.sum(), {"loss_alpha": loss.detach(), "alpha": alpha.detach()}

    @torch.no_grad()
    def backup(self, batch: FlashBatch, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Categorical target of every group and the actions it was computed with.

        A group bootstraps with its own entropy, at the joint next action of all towers;
        the least member is chosen by its expected value and its whole distribution is
        used.

        Returns:
            Target distributions (G, B, Z) and joint actions at s and s' (2B, G A).
        """
        critic, size = self.target_qvalue_network, batch.size
        _, after, _, next_future = batch.split()
        mean, std = self.actor_network(after, next_future, mode="eval")
        next_action, log_prob = sample_squashed(mean, std, noise)
        joint = torch.cat([batch.action, side_by_side(next_action)])
        half = slice(size, 2 * size)
        log_p = critic(batch.observation, joint, batch.future, mode="train", keep=half)
        least = critic.expected_value(log_p).argmin(1)  # members, never groups
        index = least[:, None, :, None].expand(-1, 1, -1, critic.num_atoms)
        target = categorical_projection(
            log_p.gather(1, index).squeeze(1).exp(),
            reward=batch.reward,
            discount=batch.discount,
            terminated=batch.terminated,
            entropy_cost=self.log_alpha.exp()[:, None] * log_prob,
            v_max=critic.v_max,
        )
        return target, joint

    def qvalue_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """``-sum_z m(z) log p(z | s, a)``, mean over groups, members and valid rows.

        Actor and temperatures are those that were already stepped in this update.

        Args:
            batch: sampled transitions.
            noise: standard normal draws of the next action, (G, B, A).

        Returns:
            Loss () and detached ``loss_qvalue``, ``td_error``, ``clip_fraction`` (G,).
        """
        target, joint = self.backup(batch, noise)
        critic, half = self.qvalue_network, slice(0, batch.size)
        log_p = critic(batch.observation, joint, batch.future, mode="train", keep=half)
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
