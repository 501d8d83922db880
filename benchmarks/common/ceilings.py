"""What a machine can do at best, measured in the run whose figures are shares of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile

from benchmarks.common.clock import now, seconds_each
from flashdex.modules.product import multiply

GPU_SIDES = (4096, 8192)
CPU_SIDES = (1024, 2048)


@contextmanager
def float32_products(precision: str) -> Iterator[None]:
    """Run the block with float32 products in TF32 (``high``) or full (``highest``).

    Args:
        precision: of ``torch.set_float32_matmul_precision``.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def matmul_gflops(device: torch.device, dtype: torch.dtype, *, seconds: float) -> float:
    """Best rate of a square matrix product on random numbers, GFLOP/s.

    Args:
        device: where.
        dtype: of operands and result.
        seconds: for each size.
    """
    best = 0.0
    for side in GPU_SIDES if device.type == "cuda" else CPU_SIDES:
        left = torch.randn(1, side, side, device=device, dtype=dtype)
        right = torch.randn(1, side, side, device=device, dtype=dtype)
        each = seconds_each(_product(left, right), device, seconds=seconds)
        best = max(best, 2 * side**3 / each / 1e9)
    return round(best, 1)


def _product(left: Tensor, right: Tensor) -> Callable[[], Tensor]:
    if left.dtype == torch.float32:  # the library's own path: oneDNN on a CPU
        return lambda: multiply(left, right)
    return lambda: torch.bmm(left, right)


def matmul_ceilings(device: torch.device, *, seconds: float = 0.5) -> dict[str, float]:
    """Rates of the number formats a learner may use, GFLOP/s.

    Args:
        device: where.
        seconds: for each format and size.

    Returns:
        ``float32`` and ``bfloat16``, on a GPU also ``tf32``.
    """
    with float32_products("highest"):
        rates = {"float32": matmul_gflops(device, torch.float32, seconds=seconds)}
    if device.type == "cuda":
        with float32_products("high"):
            rates["tf32"] = matmul_gflops(device, torch.float32, seconds=seconds)
    rates["bfloat16"] = matmul_gflops(device, torch.bfloat16, seconds=seconds)
    return rates


def gather_seconds(
    rows: int,
    width: int,
    batch: int,
    *,
    kept_on: torch.device,
    device: torch.device,
    seconds: float,
) -> float:
    """Seconds to gather random rows of one wide table and have them on the device.

    Args:
        rows: of the table; all of them are written first.
        width: bytes of a row.
        batch: rows gathered.
        kept_on: where the table lies.
        device: where the rows are wanted.
        seconds: how long to measure.
    """
    # gathers move whole numbers: eight bytes each
    table = torch.ones(rows, -(-width // 8), dtype=torch.int64, device=kept_on)

    def gather() -> Tensor:
        index = torch.randint(rows, (batch,), device=kept_on)
        return table.index_select(0, index).to(device)

    return seconds_each(gather, device, seconds=seconds)


def copy_gb_per_s(
    device: torch.device, *, num_bytes: int, seconds: float = 0.5
) -> float:
    """Bytes read plus bytes written by a plain copy, GB/s.

    Args:
        device: where.
        num_bytes: of the tensor; several times the largest cache.
        seconds: how long to measure.
    """
    source = torch.ones(num_bytes // 8, dtype=torch.int64, device=device)
    target = torch.empty_like(source)
    now(device)
    each = seconds_each(lambda: target.copy_(source), device, seconds=seconds)
    return round(2 * num_bytes / each / 1e9, 1)


# operand positions of the products among the inputs of each operator
_OPERANDS = {
    "aten::mm": (0, 1),
    "aten::bmm": (0, 1),
    "aten::addmm": (1, 2),
    "aten::baddbmm": (1, 2),
    "mkldnn::_linear_pointwise": (0, 1),
}


@dataclass(frozen=True)
class Product:
    """E products of (rows, inner) by (inner, columns)."""

    members: int
    rows: int
    inner: int
    columns: int

    @property
    def flops(self) -> int:
        """Multiplications and additions."""
        return 2 * self.members * self.rows * self.inner * self.columns


def count_products(
    call: Callable[[], object], *, repeat: int = 1
) -> dict[Product, float]:
    """How often each product runs in one call.

    The profiler gives their shapes only: its own records scatter the heap, and the
    page faults that follow make every other operator look slower than it is.

    Args:
        call: what to look at.
        repeat: calls.
    """
    with profile(activities=[ProfilerActivity.CPU], record_shapes=True) as found:
        for _ in range(repeat):
            call()
    events = found.events() or []
    counts = Counter(_read(event) for event in events if event.name in _OPERANDS)
    return {product: number / repeat for product, number in counts.items()}


def total_flops(counts: dict[Product, float]) -> float:
    """Operations of all products of one call."""
    return sum(product.flops * count for product, count in counts.items())


def _read(event: FunctionEvent) -> Product:
    shapes: Any = event.input_shapes
    left, right = (shapes[i] for i in _OPERANDS[event.name])
    members = left[0] if len(left) == 3 else 1
    # a linear layer is given its weight as (columns, inner)
    columns = right[0] if event.name.startswith("mkldnn") else right[-1]
    return Product(members, left[-2], left[-1], columns)


def replay_seconds(
    counts: dict[Product, float],
    *,
    repeat: int,
    device: torch.device | str = "cpu",
) -> float:
    """Seconds that the products of one call take by themselves, each in a tight loop.

    Args:
        counts: the products.
        repeat: runs of each product; the median counts. On a GPU they run in one row,
            and the mean counts.
        device: where.
    """
    device, total = torch.device(device), 0.0
    for product, count in counts.items():
        left = torch.randn(product.members, product.rows, product.inner, device=device)
        right = torch.randn(
            product.members, product.columns, product.inner, device=device
        )
        total += count * _seconds_of(left, right, repeat=repeat)
    return total


def _seconds_of(left: Tensor, right: Tensor, *, repeat: int) -> float:
    device, times = left.device, []
    in_a_row = 1 if device.type == "cpu" else 10 * repeat
    multiply(left, right)
    for _ in range(repeat if in_a_row == 1 else 1):
        start = now(device)
        for _ in range(in_a_row):
            multiply(left, right)
        times.append((now(device) - start) / in_a_row)
    return median(times)
