"""Primitive layers of FlashSAC: unit rows, joint-norm BatchNorm, RMSNorm.

Every weight carries a leading ensemble axis E, so that twin critics and the towers of
several groups run as one batched product. The normalisation mode is an argument of each
call and never hidden state: one network runs in different modes within one update.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from flashdex.modules.dense import linear_norm_relu
from flashdex.modules.product import product

Mode = Literal["train", "eval", "frozen"]
"""How a forward pass treats statistics and parameters.

``train``: batch statistics, running statistics move. ``eval``: running statistics.
``frozen``: as ``eval`` with detached parameters; only inputs receive gradients.
"""

NORM_EPS = 1e-8


def held(parameter: Tensor, mode: Mode) -> Tensor:
    """The parameter; without gradient when ``mode`` is frozen."""
    return parameter.detach() if mode == "frozen" else parameter


class PlainLinear(nn.Module):
    """``y = x W^T`` of E members, without projection; weights start at zero."""

    def __init__(
        self, in_features: int, out_features: int, *, ensemble: int = 1
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(ensemble, out_features, in_features))

    def forward(self, x: Tensor, *, mode: Mode = "train") -> Tensor:
        """Map ``x`` (E, B, in_features) to (E, B, out_features)."""
        return product(x, held(self.weight, mode))


class UnitLinear(PlainLinear):
    """Linear map without bias whose rows have unit length after each projection.

    Starts orthogonal (FlashSAC, table of primitive layers).

    Example:
        >>> layer = UnitLinear(3, 5, ensemble=2)
        >>> layer(torch.randn(2, 7, 3)).shape
        torch.Size([2, 7, 5])
    """

    def __init__(
        self, in_features: int, out_features: int, *, ensemble: int = 1
    ) -> None:
        super().__init__(in_features, out_features, ensemble=ensemble)
        for member in self.weight.detach():
            nn.init.orthogonal_(member)
        # orthogonal rows are not unit rows when out_features > in_features
        self.project_()

    @torch.no_grad()
    def project_(self) -> None:
        """Scale every row to length one, in place."""
        norm = torch.linalg.vector_norm(self.weight, dim=-1, keepdim=True)
        self.weight.div_(norm.clamp_min_(NORM_EPS))


def dense_relu(
    linear: UnitLinear,
    norm: UnitBatchNorm,
    x: Tensor,
    *,
    mode: Mode,
    keep: slice | None = None,
) -> Tensor:
    """``relu(norm(linear(x)))`` for E members.

    With running statistics the normalisation is affine and moves into the weights. From
    (E, B, in_features) to (E, rows, out_features): only the rows ``keep`` are returned,
    all of them enter the batch statistics.
    """
    if mode == "train":
        out, mean, var = linear_norm_relu(
            x, linear.weight, norm.weight, norm.bias, eps=norm.eps, keep=keep
        )
        norm.track_(mean, var, x.shape[1])
        return out
    scale, shift = norm.running_affine(mode)
    weight = held(linear.weight, mode) * scale.unsqueeze(-1)
    x = x if keep is None else x[:, keep]
    return product(x, weight, shift, relu=True)


class UnitBatchNorm(nn.Module):
    """BatchNorm over the batch axis; the joint norm of [gamma; beta] is sqrt(d).

    Normalises with the biased batch variance and tracks the unbiased one, momentum
    0.01, eps 1e-5. Statistics are kept per ensemble member. The layer holds state and
    projection; `dense_relu` and `InputEmbed` apply it fused with their products.

    The published statistics start at mean 0 and variance 1 and forget that over some
    hundred updates: a feature of 2 cm is shrunk thirtyfold until then. With ``warmup``
    they are the plain mean of all updates so far until the momentum takes over.

    Args:
        features: size d of the last axis.
        ensemble: number of members E.
        live: columns that are not masked, all of them by default; masked ones have
            gamma and beta zero and no part in the joint norm.
    """

    running_mean: Tensor
    running_var: Tensor
    num_tracked: Tensor

    def __init__(
        self,
        features: int,
        *,
        ensemble: int = 1,
        momentum: float = 0.01,
        eps: float = 1e-5,
        live: int | None = None,
    ) -> None:
        super().__init__()
        self.momentum = momentum
        self.eps = eps
        self.warmup = False
        self.live = features if live is None else live
        self.weight = nn.Parameter(torch.ones(ensemble, features))
        self.bias = nn.Parameter(torch.zeros(ensemble, features))
        self.register_buffer("running_mean", torch.zeros(ensemble, features))
        self.register_buffer("running_var", torch.ones(ensemble, features))
        self.register_buffer("num_tracked", torch.zeros(ensemble, 1))

    @torch.no_grad()
    def track_(self, mean: Tensor, var: Tensor, count: int) -> None:
        """Move the running statistics towards those, (E, d), of ``count`` rows."""
        unbiased = var.detach() * (count / max(count - 1, 1))
        mean = mean.detach().expand_as(self.running_mean)
        rate: Tensor | float = self.momentum
        if self.warmup:
            self.num_tracked += 1
            rate = self.num_tracked.reciprocal().clamp_min(self.momentum).to(mean.dtype)
        self.running_mean.lerp_(mean, rate)
        self.running_var.lerp_(unbiased.expand_as(self.running_var), rate)

    def running_affine(self, mode: Mode) -> tuple[Tensor, Tensor]:
        """``scale, shift`` (E, d) of the running form ``y = scale x + shift``."""
        scale = held(self.weight, mode) * torch.rsqrt(self.running_var + self.eps)
        beta = held(self.bias, mode)
        return scale, torch.addcmul(beta, scale, self.running_mean, value=-1)

    @torch.no_grad()
    def project_(self) -> None:
        """Scale gamma and beta together so that their joint norm is sqrt(d)."""
        square = self.weight.square().sum(-1, True) + self.bias.square().sum(-1, True)
        scale = self.live**0.5 * torch.rsqrt(square + NORM_EPS)
        self.weight.mul_(scale)
        self.bias.mul_(scale)


class UnitRMSNorm(nn.Module):
    """``x rsqrt(mean(x^2) + 1e-6) g`` over the last axis, norm of g is sqrt(d)."""

    def __init__(self, features: int, *, ensemble: int = 1, eps: float = 1e-6) -> None:
        super().__init__()
        self.eps = eps
        self.weight = nn.Parameter(torch.ones(ensemble, features))

    def forward(self, x: Tensor, *, mode: Mode = "train") -> Tensor:
        """Normalise ``x`` (E, B, d) over its last axis."""
        scale = torch.rsqrt(x.square().mean(-1, keepdim=True) + self.eps)
        return x * scale * held(self.weight, mode)[:, None]

    @torch.no_grad()
    def project_(self) -> None:
        """Scale g to norm sqrt(d), in place."""
        square = self.weight.square().sum(-1, keepdim=True)
        self.weight.mul_(self.weight.shape[-1] ** 0.5 * torch.rsqrt(square + NORM_EPS))


def project_(module: nn.Module) -> None:
    """Project every unit-norm layer inside ``module``, in place."""
    for layer in module.modules():
        if isinstance(layer, UnitLinear | UnitBatchNorm | UnitRMSNorm):
            layer.project_()


def warm_up_statistics(module: nn.Module) -> None:
    """Start the running statistics of every `UnitBatchNorm` inside ``module`` fresh."""
    for layer in module.modules():
        if isinstance(layer, UnitBatchNorm):
            layer.warmup = True


def restore_generator(generator: torch.Generator, state: Tensor) -> bool:
    """Set a generator to a stored state, unless that is one of another device.

    Returns:
        Whether it was set. Otherwise the generator goes on from its seed, as a run does
        that was trained on one device and goes on or is evaluated on another.
    """
    if state.numel() != generator.get_state().numel():
        return False
    generator.set_state(state.cpu())
    return True
