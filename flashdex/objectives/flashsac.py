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
from flashdex.modules.policy import target_entropy
from flashdex.objectives.batch import (
    FlashBatch,
    nested,
    read_pair,
    read_windows,
    stack_groups,
)
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.terms import (
    Metrics,
    actor_objective,
    alpha_objective,
    qvalue_objective,
)


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
        self.log_alpha = nn.Parameter(
            torch.full((len(self.groups),), float(alpha_init)).log()
        )
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
        for name, parameter in nn.Module.named_parameters(
            self, prefix, recurse, remove_duplicate
        ):
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

    # -- from TensorDict to tensors -------------------------------------------

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
        return alpha_objective(
            self.log_alpha, log_prob, weight, target_entropy=self.target_entropy
        )

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

    # -- the same on tensors, for steppers and compilers ------------------------

    def actor_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """`actor_loss` of a batch that is already read."""
        return actor_objective(
            self.actor_network,
            self.qvalue_network,
            self.log_alpha,
            batch,
            noise,
            own_action_gate=self.own_action_gate,
        )

    def qvalue_objective(
        self, batch: FlashBatch, noise: Tensor
    ) -> tuple[Tensor, Metrics]:
        """`qvalue_loss` of a batch that is already read."""
        return qvalue_objective(
            self.actor_network,
            self.qvalue_network,
            self.target_qvalue_network,
            self.log_alpha,
            batch,
            noise,
        )

    def _noise(self, tensordict: TensorDictBase, noise: Tensor | None) -> Tensor:
        if noise is not None:
            return noise
        action = tensordict.get(nested(self.groups[0], self.tensor_keys.action))
        shape = (len(self.groups), action.shape[0], self.actor_network.action_dim)
        return torch.randn(shape, dtype=action.dtype, device=action.device)
