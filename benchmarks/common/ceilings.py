"""What a machine can do at best, measured in the run whose figures are shares of it."""

from __future__ import annotations

import resource
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.benchmark import Timer
from torch.utils.flop_counter import FlopCounterMode

from flashdex.modules.product import multiply

GPU_SIDES = (4096, 8192)
MAX_WAIT = 0.3  # s, of one product
CPU_SIDES = (256, 1024, 2048)


def seconds_each(call: Callable[[], object], *, seconds: float) -> float:
    """Seconds of one call, from as many calls as fit into some seconds.

    The first calls are not counted, and a GPU is waited for after blocks of calls only.
    """
    threads = torch.get_num_threads()
    clock = Timer("call()", globals={"call": call}, num_threads=threads)
    return clock.blocked_autorange(min_run_time=max(seconds, 1e-9)).mean


def memory_gb(device: torch.device) -> dict[str, float]:
    """Memory in GB, 1e9 bytes: ``host_peak``, on a GPU ``torch_peak``, ``device_used``.

    The last is what all processes and libraries hold now, warp's arrays included.
    """
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {"host_peak": peak * (1 if sys.platform == "darwin" else 1024)}
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        found["torch_peak"] = torch.cuda.max_memory_reserved(device)
        found["device_used"] = total - free
    return {name: round(number / 1e9, 3) for name, number in found.items()}


def reset_peak_memory(device: torch.device) -> None:
    """Begin to look for the peak of torch's memory on a GPU anew."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


@contextmanager
def float32_products(precision: str) -> Iterator[None]:
    """Run the block with float32 products in TF32 (``high``) or full (``highest``)."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def matmul_gflops(device: torch.device, dtype: torch.dtype, *, seconds: float) -> float:
    """Best rate of a square matrix product on random numbers, GFLOP/s, each size.

    A processor without units for a type takes seconds a product of it; then a larger
    one is left out that would take far longer than ``seconds``.
    """
    best = 0.0
    for side in GPU_SIDES if device.type == "cuda" else CPU_SIDES:
        if best and 2 * side**3 / best / 1e9 > MAX_WAIT + 10 * seconds:
            break
        left = torch.randn(1, side, side, device=device, dtype=dtype)
        right = torch.randn(1, side, side, device=device, dtype=dtype)
        # float32 by the library's own path: oneDNN on a CPU
        call = multiply if dtype == torch.float32 else torch.bmm
        each = seconds_each(lambda: call(left, right), seconds=seconds)  # noqa: B023
        best = max(best, 2 * side**3 / each / 1e9)
    return round(best, 1)


def matmul_ceilings(device: torch.device, *, seconds: float = 0.5) -> dict[str, float]:
    """GFLOP/s of ``float32`` and ``bfloat16`` products, on a GPU also ``tf32``."""
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
    """Seconds to gather a batch of random rows of one table and have them on a device.

    The table of so many rows, each ``width`` bytes, is written first.
    """
    # gathers move whole numbers: eight bytes each
    table = torch.ones(rows, -(-width // 8), dtype=torch.int64, device=kept_on)

    def gather() -> Tensor:
        index = torch.randint(rows, (batch,), device=kept_on)
        return table.index_select(0, index).to(device)

    return seconds_each(gather, seconds=seconds)


def copy_gb_per_s(
    device: torch.device, *, num_bytes: int, seconds: float = 0.5
) -> float:
    """Bytes read plus bytes written by a plain copy of so many bytes, GB/s."""
    source = torch.ones(num_bytes // 8, dtype=torch.int64, device=device)
    target = torch.empty_like(source)
    each = seconds_each(lambda: target.copy_(source), seconds=seconds)
    return round(2 * num_bytes / each / 1e9, 1)


class Product(NamedTuple):
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
    """How often each product runs in one call, gradients included; mean of some."""
    counts: Counter[Product] = Counter()

    def of(first: int, *, columns: int = -1) -> Callable[..., int]:
        def note(*shapes: Any, **_: Any) -> int:
            left, right = shapes[first : first + 2]
            members = left[0] if len(left) == 3 else 1
            found = Product(members, left[-2], left[-1], right[columns])
            counts[found] += 1
            return found.flops

        return note

    aten = torch.ops.aten
    formulas = {aten.mm: of(0), aten.bmm: of(0), aten.addmm: of(1), aten.baddbmm: of(1)}
    if hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        # not known to torch's counter; the weight is (columns, inner)
        formulas[torch.ops.mkldnn._linear_pointwise] = of(0, columns=0)
    with FlopCounterMode(display=False, custom_mapping=formulas):
        for _ in range(repeat):
            call()
    return {found: number / repeat for found, number in counts.items()}


def total_flops(counts: dict[Product, float]) -> float:
    """Operations of all products of one call."""
    return sum(product.flops * count for product, count in counts.items())


def replay_seconds(
    counts: dict[Product, float], *, repeat: int, device: torch.device | str = "cpu"
) -> float:
    """Seconds that the products of one call take by themselves, each in a tight loop.

    The median of ``repeat`` runs counts; on a GPU they run in one row, and the mean.
    """
    device, total = torch.device(device), 0.0
    in_a_row = 1 if device.type == "cpu" else 10 * repeat
    for (members, rows, inner, columns), count in counts.items():
        left = torch.randn(members, rows, inner, device=device)
        right = torch.randn(members, columns, inner, device=device)
        clock = Timer(
            "multiply(left, right)",
            globals={"multiply": multiply, "left": left, "right": right},
            num_threads=torch.get_num_threads(),
        )
        runs = range(repeat if in_a_row == 1 else 1)
        total += count * median(clock.timeit(in_a_row).mean for _ in runs)
    return total
