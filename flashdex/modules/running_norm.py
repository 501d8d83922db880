"""Observation normalisation by statistics that are updated between rollouts."""

from __future__ import annotations

import torch
from torch import Tensor, nn

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
