"""Work of the learner beside the physics, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch


class Alongside:
    """Runs one piece of work while the body of a ``with`` block runs.

    The work and the block must share nothing that either changes; then the outcome is
    that of the work done first and the block after it, whichever is on.

    Args:
        threaded: False does just that, one after the other.

    Example:
        >>> done = []
        >>> with Alongside(threaded=True).run(lambda: done.append("work")):
        ...     pass
        >>> done
        ['work']
    """

    def __init__(self, *, threaded: bool) -> None:
        self._pool: ThreadPoolExecutor | None = None
        if threaded:
            self._pool = ThreadPoolExecutor(1, "learner")
            # A thread takes the number that is set when it first asks, and the block
            # may have lowered it for itself just then: ask now.
            self._pool.submit(torch.get_num_threads).result()

    @contextmanager
    def run(self, work: Callable[[], None] | None) -> Iterator[None]:
        """Do ``work`` beside the block; both have ended when the block is left.

        Args:
            work: what to do; None is nothing.

        Raises:
            BaseException: what ``work`` raised, unless the block raised first.
        """
        if work is None:
            yield
            return
        if self._pool is None:
            work()
            yield
            return
        future = self._pool.submit(work)
        try:
            yield
        except BaseException:
            future.exception()  # waits; the block's own error is the one to show
            raise
        future.result()

    def close(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown()
