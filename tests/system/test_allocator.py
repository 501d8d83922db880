"""Freed memory that is kept is not faulted in again."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Blocks as the activations of an update, taken and freed together, again and again.
PROGRAM = """
import resource, sys
from flashdex.system.allocator import keep_freed_memory
if sys.argv[1] == "keep":
    print(keep_freed_memory(), end=" ")
def update():
    return [b"x" * (8 << 20) for _ in range(5)]
for _ in range(3):
    update()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    update()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def _run(word: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, word],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc only")
def test_kept_memory_takes_no_page_faults():
    (without,) = _run("default")
    taken, kept = _run("keep")
    if taken == "False":
        pytest.skip("another libc")
    assert int(kept) < 0.1 * int(without)
