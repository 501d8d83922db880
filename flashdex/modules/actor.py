"""Stacked policy towers: one squashed Gaussian per group, run as one ensemble."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn

from flashdex.modules.future import FutureEncoder
from flashdex.modules.layers import Mode, PlainLinear, UnitLinear, held
from flashdex.modules.trunk import FlashTrunk

Head = Literal["centred", "unit"]

LOG_STD_RANGE: dict[str, tuple[float, float]] = {
    "centred": (-5.0, 0.0),
    "unit": (-10.0, 2.0),
}
CENTRED_MEAN_STD = 1e-3


class FlashActor(nn.Module):
    """One tower per group; each reads the full observation, emits its own action.

    ``log_std = lo + (hi - lo) / 2 (1 + tanh(raw))``. Head ``centred`` starts at mean
    about 0 and a constant std (residual and reference-centred actions); head ``unit``
    is the original one, with projected rows and log-std in [-10, 2].

    Args:
        observation_dim: width of the observation.
        action_dim: actions A of one group.
        num_groups: number of towers G.
        width: residual stream of a tower.
        num_blocks: residual blocks.
        head: kind of the output layer.
        init_std: std of the fresh centred policy; None is the middle of the log range,
            ``exp(-2.5)``.
        future_encoder: encoder with ``ensemble=num_groups``, or None.

    Example:
        >>> actor = FlashActor(9, 4, num_groups=2, width=16)
        >>> mean, std = actor(torch.randn(3, 9), mode="eval")
        >>> mean.shape
        torch.Size([2, 3, 4])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_groups: int = 1,
        width: int = 128,
        num_blocks: int = 2,
        head: Head = "centred",
        init_std: float | None = None,
        future_encoder: FutureEncoder | None = None,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.num_groups = num_groups
        self.head_kind: Head = head
        self.log_std_range = LOG_STD_RANGE[head]
        self.future_encoder = future_encoder
        latent = future_encoder.latent_dim if future_encoder is not None else 0
        self.trunk = FlashTrunk(
            observation_dim + latent, width, num_blocks=num_blocks, ensemble=num_groups
        )
        make = UnitLinear if head == "unit" else PlainLinear
        self.head = make(width, 2 * action_dim, ensemble=num_groups)
        if head == "centred":
            nn.init.normal_(self.head.weight[:, :action_dim], std=CENTRED_MEAN_STD)
        self.head_bias = nn.Parameter(torch.zeros(num_groups, 2 * action_dim))
        if init_std is not None:
            self._set_initial_std(init_std)

    @torch.no_grad()
    def _set_initial_std(self, init_std: float) -> None:
        low, high = self.log_std_range
        inside = 2.0 * (math.log(init_std) - low) / (high - low) - 1.0
        if not -1.0 < inside < 1.0:
            raise ValueError(
                f"init_std={init_std} is outside of the policy's range "
                f"({math.exp(low):.2g}, {math.exp(high):.2g}); choose a value inside."
            )
        self.head_bias[:, self.action_dim :] = math.atanh(inside)

    def forward(
        self,
        observation: Tensor,
        future: Tensor | None = None,
        *,
        mode: Mode,
        keep: slice | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Mean and std (G, B, A) of the Gaussian before the tanh.

        The observation is (B, D), the window of coming frames (B, C, K). Only the rows
        ``keep`` are returned; every row enters the batch statistics.
        """
        parts = [observation]
        if self.future_encoder is not None:
            parts.append(self.future_encoder(future, mode=mode))
        x = self.trunk(parts, mode=mode, keep=keep)
        out = self.head(x, mode=mode) + held(self.head_bias, mode)[:, None]
        mean, raw = out.split(self.action_dim, dim=-1)
        low, high = self.log_std_range
        return mean, torch.exp(low + 0.5 * (high - low) * (1.0 + torch.tanh(raw)))
