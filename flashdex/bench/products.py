"""Matrix products of a piece of code: how many, what share, and their ceiling."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile

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


@dataclass(frozen=True)
class ProductProfile:
    """What the profiler saw.

    Attributes:
        counts: how often each product ran in one call.
        share: self time of the products over that of all operators.
    """

    counts: dict[Product, float]
    share: float

    @property
    def flops(self) -> float:
        """Operations of all products of one call."""
        return sum(p.flops * count for p, count in self.counts.items())


def profile_products(call: Callable[[], object], *, repeat: int) -> ProductProfile:
    """Run ``call`` under the profiler.

    Args:
        call: what to look at; run it before, so that nothing is set up here.
        repeat: calls.
    """
    with profile(activities=[ProfilerActivity.CPU], record_shapes=True) as found:
        for _ in range(repeat):
            call()
    counts: Counter[Product] = Counter()
    spent = total = 0.0
    for event in found.events() or []:
        total += event.self_cpu_time_total
        if event.name in _OPERANDS:
            counts[_read(event)] += 1
            spent += event.self_cpu_time_total
    return ProductProfile({p: n / repeat for p, n in counts.items()}, spent / total)


def _read(event: FunctionEvent) -> Product:
    shapes: Any = event.input_shapes
    left, right = (shapes[i] for i in _OPERANDS[event.name])
    members = left[0] if len(left) == 3 else 1
    # a linear layer is given its weight as (columns, inner)
    columns = right[0] if event.name.startswith("mkldnn") else right[-1]
    return Product(members, left[-2], left[-1], columns)


def replay_seconds(found: ProductProfile, *, repeat: int) -> float:
    """Seconds that the products of one call take by themselves, each in a tight loop.

    Args:
        found: the products.
        repeat: runs of each product; the median counts.
    """
    total = 0.0
    for product, count in found.counts.items():
        left = torch.randn(product.members, product.rows, product.inner)
        right = torch.randn(product.members, product.columns, product.inner)
        times = []
        multiply(left, right)
        for _ in range(repeat):
            start = time.perf_counter()
            multiply(left, right)
            times.append(time.perf_counter() - start)
        total += count * median(times)
    return total
