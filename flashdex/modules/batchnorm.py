"""BatchNorm and relu as one differentiable function with few memory passes.

On the CPU an update is bound by the passes over activations, not by the products. The
composed operators read them about three times as often as the closed form needs.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _BatchNormRelu(torch.autograd.Function):
    """Closed-form forward and backward of `batch_norm_relu`."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, gamma: Tensor, beta: Tensor, eps: float, keep: slice
    ) -> tuple[Tensor, Tensor, Tensor]:
        mean = x.mean(1)
        centred = x - mean[:, None]
        var = centred.square().mean(1)
        rstd = torch.rsqrt(var + eps)
        kept = centred[:, keep]
        y = torch.addcmul(beta[:, None], kept, (gamma * rstd)[:, None]).relu_()
        ctx.save_for_backward(centred, y, gamma, rstd)
        ctx.keep = keep
        ctx.mark_non_differentiable(mean, var)
        return y, mean, var

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, grad_y: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        centred, y, gamma, rstd = ctx.saved_tensors
        grad = torch.ops.aten.threshold_backward(grad_y, y, 0)
        grad_beta = grad.sum(1)
        correlation = (grad * centred[:, ctx.keep]).sum(1)
        scale = gamma * rstd
        share = -scale / centred.shape[1]
        # every row of the batch receives gradient through mean and variance
        grad_x = torch.addcmul(
            (share * grad_beta)[:, None],
            centred,
            (share * rstd.square() * correlation)[:, None],
        )
        grad_x[:, ctx.keep].addcmul_(grad, scale[:, None])
        return grad_x, correlation * rstd, grad_beta, None, None


def batch_norm_relu(
    x: Tensor, gamma: Tensor, beta: Tensor, *, eps: float, keep: slice | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """``relu(gamma (x - mean) / sqrt(var + eps) + beta)`` with batch statistics.

    Args:
        x: input, (E, B, d).
        gamma: scale, (E, d).
        beta: offset, (E, d).
        eps: added to the variance.
        keep: rows to return; all rows enter the statistics.

    Returns:
        Output (E, rows, d), batch mean (E, d) and biased batch variance (E, d).
    """
    keep = slice(None) if keep is None else keep
    if not torch.compiler.is_compiling():
        return _BatchNormRelu.apply(x, gamma, beta, eps, keep)
    # a compiler fuses the plain form by itself
    mean = x.mean(1)
    centred = x - mean[:, None]
    var = centred.square().mean(1)
    scale = (gamma * torch.rsqrt(var + eps))[:, None]
    return torch.relu(centred[:, keep] * scale + beta[:, None]), mean, var
