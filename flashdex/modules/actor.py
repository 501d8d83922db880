"""Stacked policy towers: one squashed Gaussian per group, run as one ensemble."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn

from flashdex.modules.future import FutureEncoder
from flashdex.modules.layers import Mode, UnitLinear
from flashdex.modules.product import product
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
        if head == "unit":
            self.head = UnitLinear(width, 2 * action_dim, ensemble=num_groups)
        else:
            self.head = PlainLinear(width, 2 * action_dim, ensemble=num_groups)
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
        """Mean and std of the Gaussian before the tanh.

        Args:
            observation: (B, D).
            future: window of coming frames, (B, C, K), if the actor has an encoder.
            mode: see `flashdex.modules.layers.Mode`.
            keep: rows to return; every row enters the batch statistics.

        Returns:
            mean and std, (G, B, A) each.
        """
        parts = [observation]
        if self.future_encoder is not None:
            parts.append(self.future_encoder(future, mode=mode))
        x = self.trunk(parts, mode=mode, keep=keep)
        bias = self.head_bias.detach() if mode == "frozen" else self.head_bias
        out = self.head(x, mode=mode) + bias[:, None]
        mean, raw = out.split(self.action_dim, dim=-1)
        low, high = self.log_std_range
        return mean, torch.exp(low + 0.5 * (high - low) * (1.0 + torch.tanh(raw)))


class PlainLinear(nn.Module):
    """A linear map without bias and without projection; weights start at zero.

    Args:
        in_features: size of the input.
        out_features: size of the output.
        ensemble: number of members E.
    """

    def __init__(
        self, in_features: int, out_features: int, *, ensemble: int = 1
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(ensemble, out_features, in_features))

    def forward(self, x: Tensor, *, mode: Mode = "train") -> Tensor:
        """Map ``x`` (E, B, in_features) to (E, B, out_features)."""
        weight = self.weight.detach() if mode == "frozen" else self.weight
        return product(x, weight)
