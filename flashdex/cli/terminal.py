"""What every verb does with its terminal: print harmlessly, answer Ctrl-C."""

from __future__ import annotations

import io
import logging
import math
import os
import signal
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from flashdex.errors import printable

INTERRUPTED = 130  # exit code, as shells have it


def say(text: str, *, error: bool = False) -> None:
    """Print a text, on standard error if it is one.

    Names come from files: control characters are shown as escapes, and what the
    terminal's encoding does not have as well.
    """
    print(printable(text), file=sys.stderr if error else sys.stdout)


def set_up_streams() -> None:
    """Escape what the encoding of the terminal does not have, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


class Formatter(logging.Formatter):
    """Log lines without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """See ``logging``."""
        return printable(super().format(record))


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


def path(text: str) -> Path:
    """A path that a file can have, for arguments of verbs."""
    parts = [os.fsencode(part) for part in text.split("/")]
    if not text or "\0" in text or max(map(len, parts)) > 255 or len(text) > 4000:
        raise ArgumentTypeError(f"'{text[:40]}' and what follows cannot be a path")
    return Path(text)


def number_above(low: float, *, whole: bool = False) -> Callable[[str], float]:
    """A reader of finite numbers above ``low``, for arguments of verbs."""

    def read(text: str) -> float:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and low < value <= 1e9):
            kind = "an integer" if whole else "a number"
            raise ArgumentTypeError(f"'{text}' is not {kind} above {low:g}")
        return value

    return read
