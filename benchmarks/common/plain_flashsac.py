"""FlashSAC in its plainest form: the benchmark's yardstick and the tests' oracle.

Written from the equations and not from the package. There is no ensemble axis: every
tower and every critic is a stack of torch's own layers, and groups, members and
parameters are visited in Python loops.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.modules.layers import UnitBatchNorm
from flashdex.objectives.flashsac import FlashSACLoss

Source = FlashActor | EnsembleCritic


def batch_norm(features: int) -> nn.BatchNorm1d:
    """BatchNorm with momentum 0.01 and eps 1e-5."""
    norm = nn.BatchNorm1d(features, momentum=0.01)
    norm.num_batches_tracked = None  # nothing reads the count
    return norm


class PlainBlock(nn.Module):
    """``x + relu(BN(W2 relu(BN(W1 x))))``, W1: d -> 4d, W2: 4d -> d."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in ((width, 4 * width), (4 * width, width)):
            linear = nn.Linear(inputs, outputs, bias=False)
            layers += [linear, batch_norm(outputs), nn.ReLU()]
        self.body = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Transform ``x`` (B, d)."""
        return x + self.body(x)


class PlainEncoder(nn.Module):
    """Three temporal convolutions with SiLU and a linear read-out: (B, C, K) to (B, d).

    The sizes are the channels C and the widths of the convolutions.
    """

    def __init__(self, sizes: Sequence[int], inputs: int, latent: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i, (kernel, stride) in enumerate(((1, 1), (4, 2), (2, 1))):
            layers += [nn.Conv1d(sizes[i], sizes[i + 1], kernel, stride), nn.SiLU()]
        self.convolutions = nn.Sequential(*layers)
        self.read_out = nn.Linear(inputs, latent)

    def forward(self, future: Tensor) -> Tensor:
        """Encode a window of frames."""
        return self.read_out(self.convolutions(future).mT.flatten(1))


class PlainNetworks(nn.Module):
    """Separate networks that see the same observation and encoded window.

    Each is BatchNorm, linear map, blocks, RMSNorm and head, copied from a member of
    stacked networks, as is the encoder; unit heads are projected, too.
    """

    def __init__(
        self, source: Source, members: Iterable[int], *, encoder: int, unit_heads: bool
    ) -> None:
        super().__init__()
        self.unit_heads = unit_heads
        self.encoder = None
        if source.future_encoder is not None:
            self.encoder = _copy_encoder(source.future_encoder, encoder)
        self.nets = nn.ModuleList(_copy_network(source, member) for member in members)

    def see(self, observation: Tensor, future: Tensor | None) -> Tensor:
        """Observation (B, D) with the latent of the window behind it."""
        if self.encoder is None:
            return observation
        return torch.cat([observation, self.encoder(future)], -1)

    @torch.no_grad()
    def project_(self) -> None:
        """Unit rows; norm sqrt(d) of gamma and beta together, and of the RMS scale."""
        for layer in self.nets.modules():
            if isinstance(layer, nn.Linear):
                if layer.bias is None or self.unit_heads:
                    norm = layer.weight.norm(dim=-1, keepdim=True)
                    layer.weight.div_(norm.clamp_min(1e-8))
            elif isinstance(layer, nn.BatchNorm1d | nn.RMSNorm):
                total = sum(p.square().sum() for p in layer.parameters()) + 1e-8
                for parameter in layer.parameters():
                    parameter.mul_(len(parameter) ** 0.5 * torch.rsqrt(total))


@torch.no_grad()
def _copy_network(source: Source, member: int) -> nn.Sequential:
    """Both list their parameters in the order of the data."""
    trunk, head = source.trunk, source.head.weight
    outputs, width = head.shape[1:]
    inputs = trunk.embed.linear.weight.shape[-1]
    net = nn.Sequential(
        batch_norm(inputs),
        nn.Linear(inputs, width, bias=False),
        *(PlainBlock(width) for _ in trunk.blocks),
        nn.RMSNorm(width, eps=1e-6),
        nn.Linear(width, outputs),
    ).to(head)
    wanted = [*trunk.parameters(), head, source.head_bias]
    for mine, other in zip(net.parameters(), wanted, strict=True):
        mine.copy_(other[member])
    mine = [x for x in net.modules() if isinstance(x, nn.BatchNorm1d)]
    theirs = [x for x in trunk.modules() if isinstance(x, UnitBatchNorm)]
    for norm, other in zip(mine, theirs, strict=True):
        norm.running_mean = other.running_mean[member].clone()
        norm.running_var = other.running_var[member].clone()
    return net


@torch.no_grad()
def _copy_encoder(source: FutureEncoder, member: int) -> PlainEncoder:
    weights = [weight[member] for weight in source.weights]
    sizes = [weights[0].shape[1], *(len(weight) for weight in weights[:3])]
    encoder = PlainEncoder(sizes, weights[3].shape[1], len(weights[3])).to(weights[0])
    biases = [bias[member] for bias in source.biases]
    wanted = [x for pair in zip(weights, biases, strict=True) for x in pair]
    for mine, other in zip(encoder.parameters(), wanted, strict=True):
        mine.copy_(other.view_as(mine))
    return encoder


@dataclass(frozen=True)
class PlainBatch:
    """B transitions as one would lay them out for this learner."""

    observation: Tensor  # (B, D)
    next_observation: Tensor
    future: Tensor | None  # (B, C, K)
    next_future: Tensor | None
    action: Tensor  # joint action, (B, G A)
    reward: list[Tensor]  # one (B,) a group
    discount: Tensor  # gamma^k, (B,)
    terminated: Tensor  # 0 or 1, (B,)
    valid: list[Tensor] | None  # rows in which each group takes part; None is all

    def both(self) -> tuple[Tensor, Tensor | None]:
        """Rows of s above those of s': observations (2B, D), windows (2B, C, K)."""
        seen = torch.cat([self.observation, self.next_observation])
        if self.future is None or self.next_future is None:
            return seen, None
        return seen, torch.cat([self.future, self.next_future])


def read_batch(td: TensorDictBase, loss: FlashSACLoss) -> PlainBatch:
    """What the plain learner reads of a batch, not through the package."""
    after = td.get("next")
    groups = [() if group is None else (group,) for group in loss.groups]
    steps = td.get("steps", torch.full((len(td),), loss.n_steps)).flatten()
    has_future = loss.qvalue_network.future_encoder is not None
    mask = td.get("group_mask", None)
    observation = td.get("observation")
    return PlainBatch(
        observation=observation,
        next_observation=after["observation"],
        future=td["future"] if has_future else None,
        next_future=after["future"] if has_future else None,
        action=torch.cat([td[(*group, "action")] for group in groups], -1),
        reward=[after[(*group, "reward")].squeeze(-1) for group in groups],
        discount=(loss.gamma ** steps.to(observation)),
        terminated=after["terminated"].squeeze(-1).to(observation),
        valid=None if mask is None else [m.nonzero().flatten() for m in mask.mT],
    )


def sample_action(mean: Tensor, std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Squashed Gaussian sample (B, A) and its log-density (B,)."""
    u = mean + std * noise
    log_prob = torch.distributions.Normal(mean, std).log_prob(u)
    log_prob = log_prob - 2 * (math.log(2) - u - functional.softplus(-2 * u))
    return torch.tanh(u), log_prob.sum(-1)


class PlainLearner(nn.Module):
    """Separate networks, Python loops over groups, members and parameters.

    It starts from the present state of a loss of joint-action twin critics.
    """

    atoms: Tensor

    def __init__(self, loss: FlashSACLoss, *, lr: float = 3e-4) -> None:
        super().__init__()
        actor, critic = loss.actor_network, loss.qvalue_network
        self.groups = range(len(loss.groups))
        unit = actor.head_kind == "unit"
        self.actors = nn.ModuleList(
            PlainNetworks(actor, [g], encoder=g, unit_heads=unit) for g in self.groups
        )
        # layout [group, member]
        critics: dict[str, Any] = {"encoder": 0, "unit_heads": True}
        members = range(2 * len(self.groups))
        self.critics = PlainNetworks(critic, members, **critics)
        slow = loss.target_qvalue_network
        self.target = PlainNetworks(slow, members, **critics).requires_grad_(False)
        self.log_alpha = nn.Parameter(loss.log_alpha.detach().clone())
        self.log_std_range = actor.log_std_range
        self.target_entropy, self.gate = loss.target_entropy, loss.own_action_gate
        end, count = critic.v_max, critic.num_atoms
        atoms = torch.linspace(-end, end, count, dtype=torch.float64)
        self.register_buffer("atoms", atoms.to(self.log_alpha))
        self.actor_adam = torch.optim.Adam(self.actors.parameters(), lr=lr)
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=lr)
        self.critic_adam = torch.optim.Adam(self.critics.parameters(), lr=lr)
        self.updates = 0

    def compile_networks(self) -> None:
        """Compile every network, where nearly all the time goes."""
        for part in (*self.actors, self.critics, self.target):
            for net in part.nets:
                net.compile()

    def update(
        self, batch: PlainBatch, *, actor_noise: Tensor, target_noise: Tensor
    ) -> dict[str, Tensor]:
        """One update with noise (G, B, A) each.

        Returns:
            Values of each group, (G,): ``loss_qvalue``, and with an actor step
            ``loss_actor``, ``entropy`` and ``alpha`` before it.
        """
        report: dict[str, Tensor] = {}
        if self.updates % 2 == 0:
            report = self._actor_step(batch, actor_noise)
            alpha = self.log_alpha.exp()
            report["alpha"] = alpha.detach()
            excess = report["entropy"] - self.target_entropy
            _step(self.alpha_adam, (alpha * excess).sum())
        report["loss_qvalue"] = self._critic_step(batch, target_noise)
        pairs = zip(self.target.parameters(), self.critics.parameters(), strict=True)
        with torch.no_grad():
            for slow, fast in pairs:
                slow.lerp_(fast, 0.01)
        self.updates += 1
        return report

    def _policy(
        self, actor: Any, observation: Tensor, future: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        mean, raw = actor.nets[0](actor.see(observation, future)).chunk(2, -1)
        low, high = self.log_std_range
        return mean, torch.exp(low + (high - low) * (1 + torch.tanh(raw)) / 2)

    def _mean(self, values: Tensor, batch: PlainBatch, group: int) -> Tensor:
        """Mean of (B,) over the rows that count."""
        return (values if batch.valid is None else values[batch.valid[group]]).mean()

    def _actor_step(self, batch: PlainBatch, noise: Tensor) -> dict[str, Tensor]:
        size = len(batch.observation)
        drawn = []
        for actor, eps in zip(self.actors.train(), noise, strict=True):
            mean, std = self._policy(actor, *batch.both())
            drawn.append(sample_action(mean[:size], std[:size], eps))
        self.critics.requires_grad_(False).eval()
        seen = self.critics.see(batch.observation, batch.future)
        losses, entropies = [], []
        for group in self.groups:
            actions = [
                action.detach() if self.gate and g != group else action
                for g, (action, _) in enumerate(drawn)
            ]
            x = torch.cat([seen, *actions], -1)
            pair = self.critics.nets[2 * group : 2 * group + 2]
            values = [functional.softmax(net(x), -1) @ self.atoms for net in pair]
            alpha, log_prob = self.log_alpha[group].detach().exp(), drawn[group][1]
            cost = alpha * log_prob - torch.minimum(*values)
            losses.append(self._mean(cost, batch, group))
            entropies.append(-self._mean(log_prob.detach(), batch, group))
        _step(self.actor_adam, torch.stack(losses).sum())
        self.critics.requires_grad_(True)
        for actor in self.actors:
            actor.project_()
        losses, entropies = torch.stack(losses).detach(), torch.stack(entropies)
        return {"loss_actor": losses, "entropy": entropies}

    def _critic_step(self, batch: PlainBatch, noise: Tensor) -> Tensor:
        size = len(batch.observation)
        targets, joint = self._targets(batch, noise)
        x = torch.cat([self.critics.train().see(*batch.both()), joint], -1)
        losses = []
        for index, net in enumerate(self.critics.nets):
            log_p = functional.log_softmax(net(x), -1)[:size]
            cross = -(targets[index // 2] * log_p).sum(-1)
            losses.append(self._mean(cross, batch, index // 2))
        _step(self.critic_adam, torch.stack(losses).mean())
        self.critics.project_()
        return torch.stack(losses).detach().view(-1, 2).mean(1)

    @torch.no_grad()
    def _targets(self, batch: PlainBatch, noise: Tensor) -> tuple[list[Tensor], Tensor]:
        """One target distribution (B, Z) a group; joint actions at s and s', 2B rows.

        The target critics run with batch statistics over both ends of the window.
        """
        drawn = []
        for actor, eps in zip(self.actors.eval(), noise, strict=True):
            policy = self._policy(actor, batch.next_observation, batch.next_future)
            drawn.append(sample_action(*policy, eps))
        following = torch.cat([action for action, _ in drawn], -1)
        joint = torch.cat([batch.action, following])
        x = torch.cat([self.target.train().see(*batch.both()), joint], -1)
        size, targets = len(batch.observation), []
        for group, (_, log_prob) in enumerate(drawn):
            pair = self.target.nets[2 * group : 2 * group + 2]
            probs = [functional.softmax(net(x), -1)[size:] for net in pair]
            first, second = (prob @ self.atoms for prob in probs)
            least = torch.where((first <= second)[:, None], *probs)
            cost = self.log_alpha[group].exp() * log_prob
            targets.append(self._backup(least, batch, group, cost))
        return targets, joint

    def _backup(
        self, prob: Tensor, batch: PlainBatch, group: int, cost: Tensor
    ) -> Tensor:
        """``r + discount (z - cost)``, clipped, each mass split between two atoms."""
        last, end = len(self.atoms) - 1, self.atoms[-1]
        carry = batch.discount * (1 - batch.terminated)
        moved = self.atoms - cost[:, None]
        moved = batch.reward[group][:, None] + carry[:, None] * moved
        place = (moved.clamp(-end, end) + end) / (2 * end / last)
        lower = place.floor().long().clamp(0, last - 1)
        share = (place - lower).clamp(0, 1)
        target = torch.zeros_like(prob)
        target.scatter_add_(1, lower, prob * (1 - share))
        return target.scatter_add_(1, lower + 1, prob * share)


def _step(adam: torch.optim.Adam, loss: Tensor) -> None:
    adam.zero_grad()
    loss.backward()
    adam.step()
