"""The FlashSAC update in its plainest form, the yardstick of the learner benchmark."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from flashdex.bench.plain_networks import (
    NUM_ATOMS,
    V_MAX,
    PlainActor,
    PlainCritics,
    PlainTrunk,
    project,
)


@dataclass(frozen=True)
class PlainBatch:
    """B transitions as one would lay them out for this learner.

    Attributes:
        observation: (B, D).
        next_observation: (B, D).
        future: (B, C, K), or None.
        next_future: (B, C, K), or None.
        action: joint action, (B, G A).
        reward: one (B,) a group.
        discount: (B,).
        terminated: 0 or 1, (B,).
    """

    observation: Tensor
    next_observation: Tensor
    future: Tensor | None
    next_future: Tensor | None
    action: Tensor
    reward: list[Tensor]
    discount: Tensor
    terminated: Tensor

    def futures(self) -> Tensor | None:
        """Both windows one after the other, (2B, C, K), or None."""
        if self.future is None or self.next_future is None:
            return None
        return torch.cat([self.future, self.next_future])


def sample_action(mean: Tensor, std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Squashed Gaussian sample (B, A) and its log-density (B,)."""
    u = mean + std * noise
    log_prob = torch.distributions.Normal(mean, std).log_prob(u)
    log_prob = log_prob - 2 * (math.log(2) - u - functional.softplus(-2 * u))
    return torch.tanh(u), log_prob.sum(-1)


class PlainLearner:
    """Separate networks, Python loops over groups, members and parameters.

    Args:
        actors: one tower a group.
        critics: twins of all groups.
        action_dim: actions of one group.
        lr: learning rate.
    """

    def __init__(
        self,
        actors: list[PlainActor],
        critics: PlainCritics,
        *,
        action_dim: int,
        lr: float = 3e-4,
    ) -> None:
        self.actors = nn.ModuleList(actors)
        self.critics = critics
        self.target = copy.deepcopy(critics).requires_grad_(False)
        self.num_groups = len(actors)
        self.log_alpha = nn.Parameter(torch.full((len(actors),), 0.01).log())
        self.target_entropy = (
            0.5 * action_dim * math.log(2 * math.pi * math.e * 0.15**2)
        )
        self.atoms = torch.linspace(-V_MAX, V_MAX, NUM_ATOMS)
        self.actor_adam = torch.optim.Adam(self.actors.parameters(), lr=lr)
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=lr)
        self.critic_adam = torch.optim.Adam(self.critics.parameters(), lr=lr)
        self.updates = 0

    def compile(self) -> None:
        """Compile every trunk, where nearly all the time goes."""
        for network in (self.actors, self.critics, self.target):
            for part in network.modules():
                if isinstance(part, PlainTrunk):
                    part.compile()

    def update(
        self, batch: PlainBatch, *, actor_noise: Tensor, target_noise: Tensor
    ) -> dict[str, Tensor]:
        """One update with noise (G, B, A) each.

        Returns:
            ``loss_qvalue`` (), and with an actor step ``loss_actor`` () and ``alpha``
            before it, (G,).
        """
        losses: dict[str, Tensor] = {}
        if self.updates % 2 == 0:
            losses["loss_actor"], entropy = self._actor_step(batch, actor_noise)
            self.alpha_adam.zero_grad()
            alpha = self.log_alpha.exp()
            (alpha * (entropy - self.target_entropy)).sum().backward()
            losses["alpha"] = alpha.detach()
            self.alpha_adam.step()
        losses["loss_qvalue"] = self._critic_step(batch, target_noise)
        with torch.no_grad():
            pairs = zip(
                self.target.parameters(), self.critics.parameters(), strict=True
            )
            for slow, fast in pairs:
                slow.lerp_(fast, 0.01)
        self.updates += 1
        return losses

    def _actor_step(self, batch: PlainBatch, noise: Tensor) -> tuple[Tensor, Tensor]:
        size = len(batch.observation)
        both = torch.cat([batch.observation, batch.next_observation])
        futures = batch.futures()
        actions, log_probs = [], []
        for actor, eps in zip(self.actors, noise, strict=True):
            mean, std = actor(both, futures, training=True)
            action, log_prob = sample_action(mean[:size], std[:size], eps)
            actions.append(action)
            log_probs.append(log_prob)
        self.critics.requires_grad_(False)
        seen = self.critics.observe(batch.observation, batch.future)
        loss = torch.zeros(())
        for group in range(self.num_groups):
            joint = torch.cat(
                [a if g == group else a.detach() for g, a in enumerate(actions)], -1
            )
            value = self._least_value(self.critics, group, seen, joint)
            alpha = self.log_alpha[group].detach().exp()
            loss = loss + (alpha * log_probs[group] - value).mean()
        self.actor_adam.zero_grad()
        loss.backward()
        self.actor_adam.step()
        self.critics.requires_grad_(True)
        project(self.actors)
        return loss.detach(), -torch.stack(log_probs).detach().mean(-1)

    def _least_value(
        self, critics: PlainCritics, group: int, seen: Tensor, joint: Tensor
    ) -> Tensor:
        values = []
        for index in (2 * group, 2 * group + 1):
            log_p = critics.member(index, seen, joint, training=False)
            values.append((log_p.exp() * self.atoms).sum(-1))
        return torch.minimum(*values)

    def _critic_step(self, batch: PlainBatch, noise: Tensor) -> Tensor:
        size = len(batch.observation)
        both = torch.cat([batch.observation, batch.next_observation])
        targets, joint = self._targets(batch, both, noise)
        seen = self.critics.observe(both, batch.futures())
        losses = []
        for index in range(2 * self.num_groups):
            log_p = self.critics.member(index, seen, joint, training=True)[:size]
            losses.append(-(targets[index // 2] * log_p).sum(-1).mean())
        loss = torch.stack(losses).mean()
        self.critic_adam.zero_grad()
        loss.backward()
        self.critic_adam.step()
        heads = [head for head in self.critics.heads if isinstance(head, nn.Linear)]
        project(self.critics, heads)
        return loss.detach()

    @torch.no_grad()
    def _targets(
        self, batch: PlainBatch, both: Tensor, noise: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        size = len(batch.observation)
        drawn = []
        for actor, eps in zip(self.actors, noise, strict=True):
            mean, std = actor(batch.next_observation, batch.next_future, training=False)
            drawn.append(sample_action(mean, std, eps))
        next_action = torch.cat([action for action, _ in drawn], -1)
        joint = torch.cat([batch.action, next_action])
        seen = self.target.observe(both, batch.futures())
        targets = []
        for group, (_, log_prob) in enumerate(drawn):
            probs = [
                self.target.member(i, seen, joint, training=True)[size:].exp()
                for i in (2 * group, 2 * group + 1)
            ]
            values = torch.stack([(p * self.atoms).sum(-1) for p in probs])
            second = (values.argmin(0) == 1)[:, None]
            prob = torch.where(second, probs[1], probs[0])
            cost = self.log_alpha[group].exp() * log_prob
            targets.append(self._backup(prob, batch, group, cost))
        return targets, joint

    def _backup(
        self, prob: Tensor, batch: PlainBatch, group: int, cost: Tensor
    ) -> Tensor:
        carry = batch.discount * (1 - batch.terminated)
        moved = self.atoms - cost[:, None]
        moved = batch.reward[group][:, None] + carry[:, None] * moved
        place = (moved.clamp(-V_MAX, V_MAX) + V_MAX) / (2 * V_MAX / (NUM_ATOMS - 1))
        place = place.clamp(0, NUM_ATOMS - 1)
        lower = place.floor().long()
        upper = (lower + 1).clamp_max(NUM_ATOMS - 1)
        share = place - lower
        target = torch.zeros_like(prob)
        target.scatter_add_(1, lower, prob * (1 - share))
        return target.scatter_add_(1, upper, prob * share)
