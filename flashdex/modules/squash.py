"""The squashed Gaussian of the policy, as pure functions."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


def sample_squashed(mean: Tensor, std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Reparametrised sample of a tanh-squashed Gaussian and its log-density.

    ``a = tanh(u)``, ``u = mean + std eps``;
    ``log pi = sum_j log N(u_j) - 2 (log 2 - u_j - softplus(-2 u_j))``: exact, without
    an epsilon inside the logarithm.

    Args:
        mean: (..., A).
        std: (..., A), positive.
        noise: standard normal draws eps, (..., A).

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
