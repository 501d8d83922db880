"""Judging attempts: in the loop, or in a process beside it.

Building, scoring, storing and certifying a rollout takes the host ten to a thousand
milliseconds. On the cpu that is little against the physics; a GPU would stand still.
"""

from __future__ import annotations

import dataclasses
import multiprocessing as mp
import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from flashdex.errors import FlashdexError, RunError
from flashdex.rollouts.build import AttemptMaker
from flashdex.rollouts.ledger import Conversion, Ledger
from flashdex.rollouts.recorder import Episode

if TYPE_CHECKING:
    from flashdex.recipe import Recipe

MAX_PENDING = 512  # episodes in line, a megabyte each; then the loop waits


class Judging(Protocol):
    """Takes episodes in and gives first conversions out, in the order of episodes."""

    @property
    def pending(self) -> int:
        """Episodes that are not judged yet."""
        ...

    def submit(self, episode: Episode, wall_s: float) -> None:
        """Hand over one finished episode.

        Args:
            episode: of an attempt world.
            wall_s: seconds of the run.
        """
        ...

    def collect(self, *, wait: bool = False) -> list[Conversion]:
        """First conversions since the last call.

        Args:
            wait: until all episodes are judged and their lines written.

        Raises:
            OSError: a file could not be written.
            RunError: the judging process has died.
        """
        ...

    def close(self, *, wait: bool = True) -> None:
        """End.

        Args:
            wait: judge what is in line first.
        """
        ...


class JudgeHere:
    """Judges at once.

    Args:
        ledger: writes the lines.
        maker: builds the rollouts.
    """

    pending = 0

    def __init__(self, ledger: Ledger, maker: AttemptMaker) -> None:
        self.ledger, self.maker = ledger, maker
        self._found: list[Conversion] = []

    def submit(self, episode: Episode, wall_s: float) -> None:
        """See ``Judging.submit``."""
        attempt = self.maker.make(episode)
        steps = episode.env_steps
        found = self.ledger.record(attempt, env_steps=steps, wall_s=wall_s)
        if found is not None:
            self._found.append(found)

    def collect(self, *, wait: bool = False) -> list[Conversion]:
        """See ``Judging.collect``."""
        found, self._found = self._found, []
        return found

    def close(self, *, wait: bool = True) -> None:
        """Nothing is in line."""


@dataclasses.dataclass(frozen=True)
class JudgeOrder:
    """What the judging process builds its own ledger and maker from.

    Attributes:
        recipe: of the run, with the library that is in use.
        run_dir: run directory.
        made_by: engine, versions and hardware of the states.
        provenance: stored with every rollout.
        trivial: motions that a baseline already passes.
        on_gpu: a GPU steps the physics.
    """

    recipe: Recipe
    run_dir: Path
    made_by: dict[str, Any]
    provenance: dict[str, str]
    trivial: dict[str, list[str]]
    on_gpu: bool = False


Start = Callable[[JudgeOrder], tuple[Ledger, AttemptMaker]]


class JudgeBeside:
    """Judges in a process of its own, which writes all lines and rollouts.

    Args:
        ledger: follows what the process writes; it must write nothing meanwhile.
        order: for the process.
        start: what the process runs first, to build ledger and maker from the order.
    """

    def __init__(self, ledger: Ledger, order: JudgeOrder, start: Start) -> None:
        self.ledger = ledger
        # A fork would share the GPU's state. One process: lines keep their order.
        self._pool = ProcessPoolExecutor(
            1, mp_context=mp.get_context("spawn"), initializer=_begin
        )
        self._opened: Future[None] | None = self._pool.submit(_open, order, start)
        self._line: deque[Future[dict[str, Any]]] = deque()

    @property
    def pending(self) -> int:
        """Episodes that are not judged yet."""
        return len(self._line)

    def submit(self, episode: Episode, wall_s: float) -> None:
        """See ``Judging.submit``."""
        try:
            self._line.append(self._pool.submit(_judge, episode, wall_s))
        except BrokenProcessPool as error:
            raise self._died() from error

    def collect(self, *, wait: bool = False) -> list[Conversion]:
        """See ``Judging.collect``."""
        found = []
        enough = 0 if wait else MAX_PENDING
        while self._line and (len(self._line) > enough or self._line[0].done()):
            try:
                if self._opened is not None:
                    self._opened.result()
                    self._opened = None
                line = self._line[0].result()
            except BrokenProcessPool as error:
                raise self._died() from error
            self._line.popleft()
            if (conversion := self.ledger.take(line)) is not None:
                found.append(conversion)
        return found

    def _died(self) -> RunError:
        return RunError(
            f"the process that judges attempts has died with {self.pending} of them in "
            "line; those are lost. Was it killed for memory? (A script of yours that "
            "trains needs an 'if __name__ == \"__main__\":'.) Continue with 'flashdex "
            f"train --resume {self.ledger.path.parent}', or judge in the loop with "
            "train.judge=inline."
        )

    def close(self, *, wait: bool = True) -> None:
        """See ``Judging.close``."""
        try:
            if wait:
                self.collect(wait=True)
        finally:
            self._pool.shutdown(wait=wait, cancel_futures=True)


_open_parts: list[tuple[Ledger, AttemptMaker]] = []  # of the judging process


def _begin() -> None:
    """First thing in the process: live and die with the loop."""
    # A signal to the whole group ends the loop, which ends this in order.
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = mp.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # nobody waits for the rest


def _open(order: JudgeOrder, start: Start) -> None:
    import torch

    torch.set_num_threads(1)
    try:
        _open_parts.append(start(order))
    except FlashdexError as error:
        raise RunError(str(error)) from None  # others may not travel between processes


def _judge(episode: Episode, wall_s: float) -> dict[str, Any]:
    """Judge one episode; return its line, which is in the file."""
    ledger, maker = _open_parts[0]
    attempt = maker.make(episode)
    ledger.record(attempt, env_steps=episode.env_steps, wall_s=wall_s)
    return ledger.last_line
