"""Ordinary networks of the PPO baseline: a Gaussian policy and a value."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from flashdex.modules.future import FutureEncoder

HEAD_SCALE = 0.01


class _Body(nn.Module):
    """An ELU network on the observation and, where there is one, the encoded future."""

    def __init__(
        self,
        observation_dim: int,
        out_features: int,
        hidden: Sequence[int],
        encoder: FutureEncoder | None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        latent = 0 if encoder is None else encoder.latent_dim
        self.mlp = MLP(
            in_features=observation_dim + latent,
            out_features=out_features,
            num_cells=list(hidden),
            activation_class=nn.ELU,
        )

    def forward(self, observation: Tensor, future: Tensor | None) -> Tensor:
        if self.encoder is not None:
            assert future is not None
            latent = self.encoder(future)[0]
            observation = torch.cat([observation, latent], -1)
        return self.mlp(observation)


class GaussianPolicy(nn.Module):
    """Mean by a network, standard deviation the same in every state.

    The mean starts near 0: on the reference where actions are residuals.

    Args:
        observation_dim: width D of the normalised observation.
        action_dim: actions A.
        hidden: widths of the hidden layers.
        init_std: standard deviation at the start.
        encoder: encoder of the future window with ``ensemble=1``, or None.

    Example:
        >>> policy = GaussianPolicy(9, 4, hidden=[32], init_std=0.2)
        >>> mean, std = policy(torch.randn(3, 9))
        >>> mean.shape, round(std[0, 0].item(), 3)
        (torch.Size([3, 4]), 0.2)
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        hidden: Sequence[int] = (512, 256, 128),
        init_std: float = 1.0,
        encoder: FutureEncoder | None = None,
    ) -> None:
        super().__init__()
        self.body = _Body(observation_dim, action_dim, hidden, encoder)
        with torch.no_grad():
            head = self.body.mlp[-1]
            assert isinstance(head, nn.Linear)
            head.weight.mul_(HEAD_SCALE)
            head.bias.zero_()
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(init_std)))

    def forward(
        self, observation: Tensor, future: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and std (B, A) of an observation (B, D) and a window (B, C, K)."""
        mean = self.body(observation, future)
        return mean, self.log_std.exp().expand_as(mean)


class ValueNet(nn.Module):
    """Expected discounted return of a state; see `GaussianPolicy` for the arguments."""

    def __init__(
        self,
        observation_dim: int,
        *,
        hidden: Sequence[int] = (512, 256, 128),
        encoder: FutureEncoder | None = None,
    ) -> None:
        super().__init__()
        self.body = _Body(observation_dim, 1, hidden, encoder)

    def forward(self, observation: Tensor, future: Tensor | None = None) -> Tensor:
        """Value (B, 1) of the observation (B, D) and future window (B, C, K)."""
        return self.body(observation, future)


MIN_VARIANCE = 1e-6
LIMIT = 10.0


class RunningNorm(nn.Module):
    """``clip((x - mean) / sqrt(var + 1e-6), -10, 10)`` over all rows seen so far.

    Nothing is tracked on the way: who collects decides when ``update`` is called, so
    that the policy stays the same function during a rollout and its update. Before the
    first call the input is only clipped.

    Args:
        num_features: size of dimension 1 of the input.

    Example:
        >>> norm = RunningNorm(3)
        >>> norm.update(torch.randn(1000, 3) * 5 + 2)
        >>> norm(torch.full((1, 3), 2.0)).abs().max() < 0.2
        tensor(True)
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        # double: float32 stops counting at 2^24 rows
        zeros = torch.zeros(num_features, dtype=torch.float64)
        self.register_buffer("mean", zeros)
        self.register_buffer("var", torch.ones_like(zeros))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Merge the moments of ``x``, (B, D) or (B, D, K), into the running ones.

        No rows change nothing: their moments would be NaN.
        """
        rows = x.movedim(1, -1).flatten(0, -2).double()
        if not len(rows):
            return
        var, mean = torch.var_mean(rows, 0, correction=0)
        number = len(rows)
        total = self.count + number
        delta = mean - self.mean
        square = self.var * self.count + var * number
        square = square + delta.square() * self.count * number / total
        self.mean.add_(delta * number / total)
        self.var.copy_(square / total)
        self.count.copy_(total)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``x``, (B, D) or (B, D, K)."""
        shape = (-1, *[1] * (x.dim() - 2))
        mean = self.mean.to(x.dtype).view(shape)
        scale = torch.rsqrt(self.var + MIN_VARIANCE).to(x.dtype).view(shape)
        return ((x - mean) * scale).clamp(-LIMIT, LIMIT)
