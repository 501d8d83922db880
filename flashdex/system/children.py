"""Python processes that we start: none imports from the folder we are in."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from typing import Any

PYTHON = (sys.executable, "-P")
"""Begins the command line of such a process."""
_SAFE = "PYTHONSAFEPATH"


@contextmanager
def safe_path() -> Iterator[None]:
    """Python processes that anybody starts in the block are such ones."""
    before = os.environ.get(_SAFE)
    os.environ[_SAFE] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_SAFE, None)
        else:
            os.environ[_SAFE] = before


def spawning_pool(
    workers: int, initializer: Callable[..., None], *given: Any
) -> ProcessPoolExecutor:
    """A pool of fresh processes: a fork would share torch's threads and the GPU.

    Args:
        workers: how many.
        initializer: what each runs first.
        given: arguments of that.
    """
    with safe_path():  # a process that looks after semaphores begins
        return ProcessPoolExecutor(workers, _Context(), initializer, given)


class _Process(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: BaseProcess) -> Any:  # noqa: N802
        with safe_path():
            return SpawnProcess._Popen(process_obj)  # pyright: ignore


class _Context(SpawnContext):
    Process = _Process  # pyright: ignore
