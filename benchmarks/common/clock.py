"""Time and memory of a device, read only between pieces of work."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

_GIGA = 1e9


def now(device: torch.device) -> float:
    """Clock after all work given to the device is done, s.

    Args:
        device: what is waited for; a cpu is not waited for.
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def seconds_each(
    call: Callable[[], object], device: torch.device, *, seconds: float
) -> float:
    """Seconds of one call, from as many calls as fit into some seconds.

    The first call is not counted. The device is waited for after blocks of calls that
    double in size, never after each call.

    Args:
        call: what is measured.
        device: where it runs.
        seconds: how long to measure, at least one call.
    """
    call()
    block, calls = 1, 0
    start = end = now(device)
    while end - start < seconds or calls == 0:
        for _ in range(block):
            call()
        calls += block
        end = now(device)
        # no block longer than what has passed, so that the limit holds to a factor
        block = min(2 * block, max(1, int(calls * (seconds / (end - start) - 1))))
    return (end - start) / calls


def reset_peak_memory(device: torch.device) -> None:
    """Begin to look for the peak anew.

    Args:
        device: where torch allocates.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def memory_gb(device: torch.device) -> dict[str, float]:
    """Memory in GB (1e9 bytes): the host's peak, torch's peak, all of the device.

    Args:
        device: where torch allocates.

    Returns:
        ``host_peak``; on a GPU also ``torch_peak`` and ``device_used``, which is what
        all processes and libraries hold at this moment, warp's arrays included.
    """
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {"host_peak": peak * (1 if sys.platform == "darwin" else 1024)}
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        found["torch_peak"] = torch.cuda.max_memory_reserved(device)
        found["device_used"] = total - free
    return {name: round(number / _GIGA, 3) for name, number in found.items()}


def free_memory(device: torch.device) -> int:
    """Bytes that can still be allocated.

    Args:
        device: a GPU, or the cpu for the host's memory.
    """
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    info = Path("/proc/meminfo")
    if not info.is_file():  # not Linux: what cannot be known does not limit
        return sys.maxsize
    for line in info.read_text(encoding="utf-8").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return sys.maxsize
