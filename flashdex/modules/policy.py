"""The actor as a TensorDict policy with held exploration noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import softplus
from torchrl.envs.utils import ExplorationType, exploration_type

from flashdex.modules.actor import FlashActor
from flashdex.modules.exploration import NoiseRepetition


class FlashPolicy(TensorDictModuleBase):
    """Writes one action a group: stochastic under RANDOM, ``tanh(mean)`` otherwise.

    BatchNorm runs on running statistics; evaluation leaves the noise clocks alone.

    Args:
        actor: towers of all groups.
        groups: group names, one a tower; None writes a single root ``action``.
        noise: held noise.
        observation: key of the observation, (N, D).
        future: key of the future window, (N, C, K), read if the actor has an encoder.
        action: name of the action inside its group.
        deterministic_key: key of a flag (N, 1); where it is true, actions are
            deterministic even under RANDOM. None: no such flag.
    """

    def __init__(
        self,
        actor: FlashActor,
        *,
        groups: Sequence[str] | None = None,
        noise: NoiseRepetition | None = None,
        observation: NestedKey = "observation",
        future: NestedKey = "future",
        action: str = "action",
        deterministic_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        self.deterministic_key = deterministic_key
        self.actor = actor
        self.noise = NoiseRepetition() if noise is None else noise
        keys: list[Any] = [observation, future]
        self.in_keys = keys if actor.future_encoder is not None else keys[:1]
        writes: list[Any] = [action]
        if groups is not None:
            writes = [(group, action) for group in groups]
        self.out_keys = writes

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set the action of every group; any batch shape."""
        batch = tensordict.batch_size
        inputs = [tensordict.get(key) for key in self.in_keys]
        inputs = [x.reshape(-1, *x.shape[len(batch) :]) for x in inputs]
        mean, std = self.actor(*inputs, mode="eval")
        if exploration_type() == ExplorationType.RANDOM:
            noise = self.noise(tuple(mean.shape)).to(mean.dtype)
            if self.deterministic_key is not None:
                flag = tensordict.get(self.deterministic_key)
                noise = noise.masked_fill(flag.reshape(-1, 1), 0)
            mean = mean + std * noise
        action = torch.tanh(mean)
        for key, value in zip(self.out_keys, action.unbind(0), strict=True):
            tensordict.set(key, value.reshape(*batch, -1))
        return tensordict


LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


def sample_squashed(mean: Tensor, std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Reparametrised sample of a tanh-squashed Gaussian and its log-density.

    ``a = tanh(u)``, ``u = mean + std eps``;
    ``log pi = sum_j log N(u_j) - 2 (log 2 - u_j - softplus(-2 u_j))``: exact, without
    an epsilon inside the logarithm.

    Returns:
        Action in [-1, 1], (..., A), and log-density, (...).
    """
    u = mean + std * noise
    normal = -0.5 * noise.square() - std.log()
    jacobian = 2.0 * (u + softplus(-2.0 * u))
    constant = mean.shape[-1] * (LOG_SQRT_2PI + 2.0 * math.log(2.0))
    return torch.tanh(u), (normal + jacobian).sum(-1) - constant


def target_entropy(action_dim: int, sigma: float = 0.15) -> float:
    """``0.5 A ln(2 pi e sigma^2)``: entropy of A independent Gaussians of width sigma.

    Example:
        >>> round(target_entropy(18), 4)
        -8.6073
    """
    return 0.5 * action_dim * math.log(2.0 * math.pi * math.e * sigma**2)
