"""Scale of the rewards: discounted return statistics, one stream per group."""

from __future__ import annotations

import torch
from torch import Tensor, nn

MIN_VARIANCE = 1e-8
PRIOR_COUNT = 1e-4


class RewardNormalizer(nn.Module):
    """Running statistics of the discounted return ``G <- gamma (1 - d) G + r``.

    ``denominator = max(sqrt(var + 1e-8), G_max / bound)``; rewards are divided by it
    when a batch is sampled, so that old rows stay consistent while the scale drifts.
    ``gamma`` is the one-step discount even with n-step returns. There is no centring.

    Args:
        num_envs: environments N that are collected from.
        num_groups: reward streams G.
        gamma: one-step discount.
        bound: largest scaled return; equals ``v_max`` of the critic.

    Example:
        >>> norm = RewardNormalizer(1, gamma=0.99)
        >>> norm.update(torch.ones(1, 1), torch.zeros(1, dtype=torch.bool))
        >>> norm.denominator()
        tensor([0.2000])
    """

    returns: Tensor
    returns_max: Tensor
    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(
        self,
        num_envs: int,
        num_groups: int = 1,
        *,
        gamma: float,
        bound: float = 5.0,
    ) -> None:
        super().__init__()
        self.gamma, self.bound = gamma, bound
        # double: float32 stops counting at 2^24 rows
        returns = torch.zeros(num_envs, num_groups, dtype=torch.float64)
        self.register_buffer("returns", returns)
        for name in ("returns_max", "mean", "var", "count"):
            self.register_buffer(name, torch.zeros(num_groups, dtype=torch.float64))
        self.var.fill_(1.0)

    @torch.no_grad()
    def update(self, reward: Tensor, done: Tensor, mask: Tensor | None = None) -> None:
        """Take in one vector step, in the order of time.

        Args:
            reward: raw rewards, (N, G).
            done: terminated or truncated, (N,) or (N, 1).
            mask: entries that count, (N, G) bool; default all.
        """
        alive = 1.0 - done.reshape(-1, 1).to(self.returns.dtype)
        all_count = torch.ones_like(self.returns)
        weight = all_count if mask is None else mask.to(self.returns)
        # the done of this step wipes the past before its reward is added
        returns = (self.gamma * alive * self.returns + reward) * weight
        self.returns.copy_(returns)
        peak = returns.abs().amax(0)
        self.returns_max.copy_(torch.maximum(self.returns_max, peak))
        number = weight.sum(0)
        safe = number.clamp_min(1.0)
        batch_mean = returns.sum(0) / safe
        batch_var = ((returns - batch_mean).square() * weight).sum(0) / safe
        delta = batch_mean - self.mean
        total = self.count + number
        square = self.var * (self.count + PRIOR_COUNT) + batch_var * number
        divisor = total.clamp_min(1.0)
        square = square + delta.square() * self.count * number / divisor
        self.mean.add_(delta * number / divisor)
        self.var.copy_(torch.where(number > 0, square / divisor, self.var))
        self.count.copy_(total)

    def denominator(self) -> Tensor:
        """Divisor of the rewards, (G,), float32."""
        spread = torch.sqrt(self.var + MIN_VARIANCE)
        return torch.maximum(spread, self.returns_max / self.bound).float()

    def clear_returns(self) -> None:
        """Forget unfinished episodes: after a resume their environments are gone."""
        self.returns.zero_()
