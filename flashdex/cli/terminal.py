"""What every verb does with its terminal: print harmlessly, read words."""

from __future__ import annotations

import io
import logging
import math
import os
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

from flashdex.errors import printable


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


def path(text: str) -> Path:
    """A path that a file can have, for arguments of verbs; `~/` is the home folder."""
    return Path(path_text(text))


def path_text(text: str) -> str:
    """The same with the slash at its end, where that says something."""
    text = os.path.expanduser(text) if text.startswith("~/") else text
    parts = [os.fsencode(part) for part in text.split("/")]
    if not text or "\0" in text or max(map(len, parts)) > 255 or len(text) > 4000:
        raise ArgumentTypeError(f"'{text[:40]}' and what follows cannot be a path")
    return text


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
