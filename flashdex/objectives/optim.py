"""Adam with the cosine schedule of FlashSAC, and the target average."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


def cosine_rate(step: int, total: int | None, *, peak: float, end: float) -> float:
    """``end + (peak - end) / 2 (1 + cos(pi step / total))``; constant without a total.

    Args:
        step: steps already taken by this optimiser.
        total: horizon, the number of critic updates of the run; None is constant.
        peak: first learning rate.
        end: last learning rate.
    """
    if total is None:
        return peak
    phase = math.pi * min(step, total) / total
    return end + 0.5 * (peak - end) * (1.0 + math.cos(phase))


class ScheduledAdam:
    """Adam (.9, .999, 1e-8, no decay) that advances its own cosine once a step.

    Args:
        parameters: what to train.
        peak: first learning rate.
        end: last learning rate.
        total: horizon of the cosine in critic updates; None keeps ``peak``.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        *,
        peak: float = 3e-4,
        end: float = 1.5e-4,
        total: int | None = None,
    ) -> None:
        self.peak, self.end, self.total = peak, end, total
        self.steps = 0
        self.adam = torch.optim.Adam(list(parameters), lr=peak, fused=True)

    @property
    def rate(self) -> float:
        """Learning rate of the coming step."""
        return cosine_rate(self.steps, self.total, peak=self.peak, end=self.end)

    def step(self, loss: Tensor) -> None:
        """Differentiate ``loss``, step, clear the gradients, advance the schedule."""
        loss.backward()
        for group in self.adam.param_groups:
            group["lr"] = self.rate
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        self.steps += 1

    def state_dict(self) -> dict[str, Any]:
        """Moments and schedule position."""
        return {"adam": self.adam.state_dict(), "steps": self.steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.adam.load_state_dict(state["adam"])
        self.steps = state["steps"]


class TargetAverage:
    """``theta_t <- theta_t + tau (theta - theta_t)`` on parameters only.

    BatchNorm buffers of the target are its own: neither copied nor averaged.

    Args:
        source: online network.
        target: network of the same structure.
        tau: rate.
    """

    def __init__(self, source: nn.Module, target: nn.Module, *, tau: float) -> None:
        self.source = [p.detach() for p in source.parameters()]
        self.target = [p.detach() for p in target.parameters()]
        self._average = get_ema_multi_avg_fn(1.0 - tau)

    @torch.no_grad()
    def step(self) -> None:
        """Move the target one step."""
        self._average(self.target, self.source, None)
