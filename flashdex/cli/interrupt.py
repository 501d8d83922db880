"""What is heard and said while libraries load; imported first, so imports little."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130  # exit code, as shells have it
PATIENCE_S = 3.0  # after which somebody at a terminal is told what takes so long


@contextmanager
def loading() -> Iterator[None]:
    """While libraries load, a terminal is told so, and Ctrl-C ends the process."""
    timer = threading.Timer(PATIENCE_S, _tell)
    timer.daemon = True
    if sys.stderr is not None and sys.stderr.isatty():
        timer.start()
    try:
        with _leaving():
            yield
    finally:
        timer.cancel()


def _tell() -> None:
    sys.stderr.write("loading libraries ...\n")


@contextmanager
def _leaving() -> Iterator[None]:
    """Ctrl-C ends the process at once.

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
