"""Products of all ensemble members, through the fastest kernels the device has.

On the CPU in float32 they run in oneDNN, one call a member: torch's own ``bmm`` asks
MKL, whose kernels use half the vector width of processors of other makers. Measured on
an AMD EPYC with AVX-512: 160 to 200 against 85 GFLOP/s.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

_HAS_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(
    torch.ops.mkldnn, "_linear_pointwise"
)
# below this many multiplications a member start-up and casts cost more than they save
_LARGE = 1 << 21
_state = threading.local()


@contextmanager
def bfloat16_products(enabled: bool = True) -> Iterator[None]:
    """Round both operands and the result of large float32 products to bfloat16.

    It holds for what this thread computes inside, and for its gradients. Everything
    else stays in float32: statistics, normalisation, softmax, losses, weights. With
    ``enabled=False`` nothing changes.
    """
    before = are_bfloat16()
    _state.lowered = enabled or before
    try:
        yield
    finally:
        _state.lowered = before


@contextmanager
def tf32_products(enabled: bool = True) -> Iterator[None]:
    """Compute float32 products of a GPU in TF32 inside, and those after it as before.

    Small products elsewhere, rotations of rewards and observations, keep all digits.
    With ``enabled=False`` nothing changes.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if enabled else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@torch.compiler.assume_constant_result
def are_bfloat16() -> bool:
    """Whether `bfloat16_products` is on in this thread."""
    return getattr(_state, "lowered", False)


def multiply(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    relu: bool = False,
    lowered: bool = False,
) -> Tensor:
    """``x W^T + bias`` and optionally relu, without gradient.

    ``x`` is (E, B, K), the weight (E, N, K), the bias (E, N), of any strides; the
    result (E, B, N) is contiguous. For ``lowered`` see `bfloat16_products`.
    """
    large = _is_large_float32(x, weight)
    if large and lowered:
        out = torch.bmm(x.bfloat16(), weight.bfloat16().mT).float()
        out = out if bias is None else out.add_(bias[:, None])
        return out.relu_() if relu else out
    if large and _HAS_ONEDNN and x.device.type == "cpu":
        if torch.compiler.is_compiling():
            # the compiler's own form of the operator takes constant weights only
            return torch.ops.flashdex.multiply.default(x, weight, bias, relu)
        return _multiply_by_onednn(x, weight, bias, relu)
    if bias is None:
        out = torch.bmm(x, weight.mT)
    else:
        out = torch.baddbmm(bias[:, None], x, weight.mT)
    return out.relu_() if relu else out


def _is_large_float32(x: Tensor, weight: Tensor) -> bool:
    size = x.shape[1] * x.shape[2] * weight.shape[1]
    return size >= _LARGE and x.dtype == torch.float32


def _multiply_by_onednn(
    x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool
) -> Tensor:
    biases = [None] * len(x) if bias is None else bias.unbind(0)
    rows = zip(x.unbind(0), weight.unbind(0), biases, strict=True)
    members = [_onednn(*row, "relu" if relu else "none") for row in rows]
    return members[0].unsqueeze(0) if len(members) == 1 else torch.stack(members)


torch.library.define(
    "flashdex::multiply",
    "(Tensor x, Tensor weight, Tensor? bias, bool relu) -> Tensor",
)
torch.library.impl("flashdex::multiply", "cpu")(_multiply_by_onednn)


@torch.library.register_fake("flashdex::multiply")
def _shape_of_multiply(
    x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool
) -> Tensor:
    return x.new_empty(x.shape[0], x.shape[1], weight.shape[1])


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None, after: str) -> Tensor:
    # the operator that torch's compiler emits for linear layers
    return torch.ops.mkldnn._linear_pointwise.default(
        _dense(x), _dense(weight), bias, after, [], ""
    )


def _dense(matrix: Tensor) -> Tensor:
    """The matrix or a copy without gaps: others fall to kernels 1000 times slower."""
    if matrix.is_contiguous() or matrix.mT.is_contiguous():
        return matrix
    return matrix.contiguous()


def multiply_rows(a: Tensor, b: Tensor, *, lowered: bool = False) -> Tensor:
    """``a^T b``: the gradient of a weight, (E, B, N) and (E, B, K) to (E, N, K)."""
    if a.shape[1] == 1:
        return a.mT * b
    if a.shape[-1] <= b.shape[-1]:
        return multiply(a.mT, b.mT, lowered=lowered)
    # few rows and many columns suit the kernels better than the reverse
    return multiply(b.mT, a.mT, lowered=lowered).mT


class _Product(torch.autograd.Function):
    """`product`, optionally with relu, and its gradients."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        relu: bool,
        lowered: bool,
    ) -> Tensor:
        out = multiply(x, weight, bias, relu=relu, lowered=lowered)
        ctx.lowered = lowered
        ctx.save_for_backward(x, weight, out if relu else None)
        return out

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, grad: Tensor
    ) -> tuple[Tensor | None, ...]:
        x, weight, out = ctx.saved_tensors
        if out is not None:
            grad = torch.ops.aten.threshold_backward(grad, out, 0)
        wants, lowered = ctx.needs_input_grad, ctx.lowered
        return (
            multiply(grad, weight.mT, lowered=lowered) if wants[0] else None,
            multiply_rows(grad, x, lowered=lowered) if wants[1] else None,
            grad.sum(1) if wants[2] else None,
            None,
            None,
        )


def product(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, *, relu: bool = False
) -> Tensor:
    """Differentiable ``x W^T + bias`` of E members, optionally with relu.

    ``x`` is (E, B, K), the weight (E, N, K), the bias (E, N); the result (E, B, N).

    Example:
        >>> product(torch.ones(2, 7, 3), torch.ones(2, 5, 3)).shape
        torch.Size([2, 7, 5])
    """
    lowered = are_bfloat16()
    if not torch.is_grad_enabled():
        return multiply(x, weight, bias, relu=relu, lowered=lowered)
    return _Product.apply(x, weight, bias, relu, lowered)
