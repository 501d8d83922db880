"""Ctrl-C while libraries load; imported first, so it imports little."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130  # exit code, as shells have it


@contextmanager
def loading() -> Iterator[None]:
    """While libraries load, Ctrl-C ends the process at once.

    An import may swallow KeyboardInterrupt, and the verb would go on for hours; nothing
    is there yet that an orderly end would save. A process that ignores Ctrl-C still
    does, and a thread of a program that calls ``main`` is left alone.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        yield
        return
    try:
        signal.signal(signal.SIGINT, _leave)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
