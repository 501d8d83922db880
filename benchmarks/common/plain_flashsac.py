"""The FlashSAC update in its plainest form, the yardstick of the learner benchmark."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

NUM_ATOMS, V_MAX = 101, 5.0


class PlainBatchNorm(nn.Module):
    """BatchNorm of (B, d) whose mode is an argument of the call.

    Args:
        features: size d.
    """

    mean: Tensor
    var: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(features))
        self.bias = nn.Parameter(torch.zeros(features))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("var", torch.ones(features))

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Normalise ``x``; training moves the running statistics by 0.01."""
        return functional.batch_norm(
            x, self.mean, self.var, self.weight, self.bias, training, 0.01, 1e-5
        )


class PlainBlock(nn.Module):
    """``x + relu(BN(W2 relu(BN(W1 x))))``.

    Args:
        width: size of the residual stream.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(width, 4 * width, bias=False)
        self.norm1 = PlainBatchNorm(4 * width)
        self.linear2 = nn.Linear(4 * width, width, bias=False)
        self.norm2 = PlainBatchNorm(width)

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Transform ``x`` (B, width)."""
        y = functional.relu(self.norm1(self.linear1(x), training=training))
        return x + functional.relu(self.norm2(self.linear2(y), training=training))


class PlainTrunk(nn.Module):
    """BatchNorm, linear map, blocks and one RMSNorm.

    Args:
        inputs: width of the input.
        width: size of the residual stream.
        num_blocks: residual blocks.
    """

    def __init__(self, inputs: int, width: int, num_blocks: int = 2) -> None:
        super().__init__()
        self.norm_in = PlainBatchNorm(inputs)
        self.embed = nn.Linear(inputs, width, bias=False)
        self.blocks = nn.ModuleList(PlainBlock(width) for _ in range(num_blocks))
        self.rms = nn.RMSNorm(width, eps=1e-6)

    def forward(self, x: Tensor, *, training: bool) -> Tensor:
        """Features (B, width) of ``x`` (B, inputs)."""
        x = self.embed(self.norm_in(x, training=training))
        for block in self.blocks:
            x = block(x, training=training)
        return self.rms(x)


class PlainEncoder(nn.Module):
    """Three temporal convolutions with SiLU and a linear read-out.

    Args:
        channels: features of one frame.
        num_frames: frames of the window.
        latent: size of the output.
        widths: output channels of the convolutions.
    """

    def __init__(
        self, channels: int, num_frames: int, latent: int, widths: tuple[int, int, int]
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(channels, widths[0], 1)
        self.conv2 = nn.Conv1d(widths[0], widths[1], 4, stride=2)
        self.conv3 = nn.Conv1d(widths[1], widths[2], 2)
        length = (num_frames - 4) // 2
        self.read_out = nn.Linear(length * widths[2], latent)

    def forward(self, future: Tensor) -> Tensor:
        """Encode (B, channels, num_frames) to (B, latent)."""
        x = functional.silu(self.conv1(future))
        x = functional.silu(self.conv2(x))
        x = functional.silu(self.conv3(x))
        return self.read_out(x.mT.flatten(1))


class PlainActor(nn.Module):
    """One policy tower with the centred head.

    Args:
        inputs: width of the observation, latent included.
        action_dim: actions A.
        width: residual stream.
        encoder: of the future window, or None.
    """

    def __init__(
        self, inputs: int, action_dim: int, width: int, encoder: PlainEncoder | None
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.trunk = PlainTrunk(inputs, width)
        self.mean_head = nn.Linear(width, action_dim)
        self.std_head = nn.Linear(width, action_dim)

    def forward(
        self, observation: Tensor, future: Tensor | None, *, training: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and std, (B, A) each."""
        x = join(observation, self.encoder, future)
        x = self.trunk(x, training=training)
        log_std = -5.0 + 2.5 * (1.0 + torch.tanh(self.std_head(x)))
        return self.mean_head(x), log_std.exp()


class PlainCritics(nn.Module):
    """Twin critics of all groups as separate networks over one shared encoder.

    Args:
        inputs: width of observation, latent and joint action together.
        width: residual stream.
        num_groups: groups G.
        encoder: of the future window, or None.
    """

    def __init__(
        self, inputs: int, width: int, num_groups: int, encoder: PlainEncoder | None
    ) -> None:
        super().__init__()
        self.encoder = encoder
        count = 2 * num_groups
        self.trunks = nn.ModuleList(PlainTrunk(inputs, width) for _ in range(count))
        self.heads = nn.ModuleList(nn.Linear(width, NUM_ATOMS) for _ in range(count))

    def observe(self, observation: Tensor, future: Tensor | None) -> Tensor:
        """Observation and latent side by side: the same for all members."""
        return join(observation, self.encoder, future)

    def member(
        self, index: int, seen: Tensor, action: Tensor, *, training: bool
    ) -> Tensor:
        """Log-probabilities (B, Z) of member ``2 group + twin``."""
        x = torch.cat([seen, action], -1)
        x = self.trunks[index](x, training=training)
        return functional.log_softmax(self.heads[index](x), -1)


def join(
    observation: Tensor, encoder: PlainEncoder | None, future: Tensor | None
) -> Tensor:
    """Observation with the latent of the window behind it."""
    if encoder is None:
        return observation
    assert future is not None
    return torch.cat([observation, encoder(future)], -1)


@torch.no_grad()
def project(module: nn.Module, unit_heads: Iterable[nn.Linear] = ()) -> None:
    """Unit rows, joint norm sqrt(d) of gamma and beta, norm sqrt(d) of the RMS scale.

    Args:
        module: network whose trunks are projected.
        unit_heads: linear maps outside of the trunks with unit rows.
    """
    linears = list(unit_heads)
    for part in module.modules():
        if isinstance(part, PlainTrunk):
            linears.append(part.embed)
        elif isinstance(part, nn.RMSNorm):
            scale = part.weight
            scale.mul_(len(scale) ** 0.5 * torch.rsqrt(scale.square().sum() + 1e-8))
        elif isinstance(part, PlainBlock):
            linears += [part.linear1, part.linear2]
        elif isinstance(part, PlainBatchNorm):
            total = part.weight.square().sum() + part.bias.square().sum()
            factor = len(part.weight) ** 0.5 * torch.rsqrt(total + 1e-8)
            part.weight.mul_(factor)
            part.bias.mul_(factor)
    for linear in linears:
        weight = linear.weight
        weight.div_(weight.norm(dim=-1, keepdim=True).clamp_min(1e-8))


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
