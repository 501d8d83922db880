"""The base of all stand-ins, and the checks they share."""

from __future__ import annotations

import pickle
import pickletools
from collections.abc import Callable
from typing import IO, Any

import numpy as np

Value = Callable[[Any], Any]

MAX_BYTES = 4 << 30  # of what a file becomes; more is a mistake or an attack
MEMO_PUTS = {"PUT", "BINPUT", "LONG_BINPUT"}


class RefusedError(Exception):
    """A pickle asks for something that is not data; the text is its name."""


class StandIn:
    """Keeps the arguments and the state that a pickle gives to an object."""

    args: tuple
    state: Any

    def __new__(cls, *args: Any) -> StandIn:
        """Keep the arguments here: pickles may skip ``__init__``."""
        made = object.__new__(cls)
        made.args, made.state = args, None
        return made

    # Every stand-in takes its state here: pickle would set attributes otherwise.
    def __setstate__(self, state: Any) -> None:
        self.state = state

    def value(self, plain: Value) -> Any:
        """The value this stands for; ``plain`` turns parts of it into values."""
        raise ValueError(f"a bare {type(self).__name__} is not data")


def check_sizes(sizes: Any) -> tuple[int, ...]:
    """Sizes as a tuple of whole numbers from 0 up.

    Raises:
        ValueError: they are something else.
    """
    sizes = (sizes,) if isinstance(sizes, int) else sizes
    if not isinstance(sizes, (tuple, list)):
        raise ValueError(f"{sizes!r} are not sizes")
    whole = [isinstance(n, (int, np.integer)) and 0 <= n <= MAX_BYTES for n in sizes]
    if not all(whole) or len(sizes) > 32:
        raise ValueError(f"{sizes!r} are not sizes")
    return tuple(int(n) for n in sizes)


def check_pickle(file: IO[bytes]) -> None:
    """Read over one pickle, from its start to its end, without building anything.

    The pickle machine itself allocates whatever a length or a place in its memo says,
    tens of gigabytes for ten bytes of file; after this check both are true.

    Raises:
        ValueError: the pickle is torn, or uses its memo as no pickler does.
    """
    puts = 0
    for code, part, _ in pickletools.genops(file):
        if code.name in MEMO_PUTS:
            if not isinstance(part, int) or part > puts:
                raise pickle.UnpicklingError("the memo of the pickle is not in order")
            puts += 1
        elif code.name == "MEMOIZE":
            puts += 1
