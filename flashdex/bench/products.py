"""Matrix products of a piece of code: which ones, and how fast they can be at best."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile

from flashdex.bench.clock import now
from flashdex.modules.product import multiply

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
