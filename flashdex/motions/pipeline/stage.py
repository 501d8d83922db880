"""What is being done now: told by the stages of a motion, heard by a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from flashdex.errors import printable

Listener = Callable[[str], None]
_LISTENERS: list[Listener] = []


def tell(name: str, stage: str) -> None:
    """Say which stage of which motion begins; nobody may be listening."""
    shown = printable(name).replace("\n", " ")
    for listener in _LISTENERS:
        listener(f"{shown[:40]}: {stage}")


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Hear what is told in this process while the block runs."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)
