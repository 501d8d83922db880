"""What every verb does with its terminal: print harmlessly, read words."""

from __future__ import annotations

import io
import logging
import math
import os
import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable
from pathlib import Path

from flashdex.errors import printable
from flashdex.system.run_files import require_run


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


def set_up_logging(*, debug: bool) -> None:
    """Show log lines on standard error; ``debug`` shows all of them."""
    handler = logging.StreamHandler()
    handler.setFormatter(Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    # of other packages only what is wrong: OpenGL reports what it has not found
    level = logging.DEBUG if debug else logging.WARNING
    logging.basicConfig(level=level, handlers=[handler])
    logging.getLogger("flashdex").setLevel(min(level, logging.INFO))


def check_words(args: Namespace) -> None:
    """Refuse what the words alone show, before anything large is loaded."""
    run = getattr(args, "resume", None)
    if run is not None or args.verb in ("evaluate", "report"):
        require_run(run or args.run_dir)
    elif getattr(args, "recipe", None) and hasattr(args, "overrides"):
        from flashdex.recipe.overrides import check_words as check
        from flashdex.recipe.overrides import expand_sweeps

        words = args.overrides
        is_grid = getattr(args, "multirun", False)
        check(args.recipe, expand_sweeps(words) if is_grid else [words])


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
