"""Memory that is freed and allocated again every update stays with the process."""

from __future__ import annotations

import ctypes
import sys

# parameters of glibc's mallopt, <malloc.h>
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_MEGABYTE = 1 << 20


def keep_freed_memory(*, megabytes: int = 1024) -> bool:
    """Tell glibc to keep freed memory instead of giving it back to the system.

    By default blocks above some size are mapped anew each time and the top of the heap
    is returned; an update of the learner then takes thousands of page faults, 10 to
    15 % of its time. The setting holds for the whole process; peak memory is unchanged.
    False where the allocator does not take it, as outside of Linux with glibc.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    kept = min(megabytes * _MEGABYTE, 2**31 - 1)
    # some versions refuse a mapping threshold above 32 MB
    mapped = mallopt(_MMAP_THRESHOLD, kept) or mallopt(
        _MMAP_THRESHOLD, min(kept, 32 * _MEGABYTE)
    )
    trimmed = mallopt(_TRIM_THRESHOLD, kept)
    padded = mallopt(_TOP_PAD, 64 * _MEGABYTE)
    return bool(mapped and trimmed and padded)
