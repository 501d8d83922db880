"""Judging attempts: in the loop, or in a process beside it.

Building, scoring, storing and certifying a rollout takes the host ten to a thousand
milliseconds. On the cpu that is little against the physics; a GPU would stand still.
"""

from __future__ import annotations

import dataclasses
import multiprocessing as mp
import os
import queue
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from flashdex.errors import RunError
from flashdex.training.attempt_ring import Episode
from flashdex.training.attempts import AttemptMaker
from flashdex.training.ledger import Conversion, Ledger

if TYPE_CHECKING:
    from flashdex.recipe import Recipe

MAX_PENDING = 512  # episodes in line, a megabyte each; then the loop waits
_ALIVE_S = 2.0  # how often each side looks whether the other still lives


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
    """

    recipe: Recipe
    run_dir: Path
    made_by: dict[str, Any]
    provenance: dict[str, str]
    trivial: dict[str, list[str]]


class JudgeBeside:
    """Judges in a process of its own, which writes all lines and rollouts.

    Args:
        ledger: follows what the process writes; it must write nothing meanwhile.
        order: for the process.
        start: what the process runs first, to build ledger and maker from the order.
    """

    def __init__(
        self,
        ledger: Ledger,
        order: JudgeOrder,
        start: Callable[[JudgeOrder], tuple[Ledger, AttemptMaker]],
    ) -> None:
        self.ledger = ledger
        self.pending = 0
        context = mp.get_context("spawn")  # a fork would share the GPU's state
        self._tasks: Any = context.Queue()
        self._answers: Any = context.Queue()
        self._process = context.Process(
            target=_judge,
            args=(order, start, self._tasks, self._answers),
            name="judge",
            daemon=True,
        )
        self._process.start()

    def submit(self, episode: Episode, wall_s: float) -> None:
        """See ``Judging.submit``."""
        self._tasks.put((episode, wall_s))
        self.pending += 1

    def collect(self, *, wait: bool = False) -> list[Conversion]:
        """See ``Judging.collect``."""
        found = []
        enough = 0 if wait else MAX_PENDING
        while self.pending:
            try:
                patience = _ALIVE_S if self.pending > enough else 0.0
                line = self._answers.get(patience > 0, patience)
            except queue.Empty:
                if not self._process.is_alive():
                    raise self._died() from None
                if self.pending > enough:
                    continue
                break
            if isinstance(line, Exception):
                raise line
            self.pending -= 1
            if (conversion := self.ledger.take(line)) is not None:
                found.append(conversion)
        return found

    def _died(self) -> RunError:
        return RunError(
            f"the process that judges attempts has died (exit code "
            f"{self._process.exitcode}) with {self.pending} of them in line; those are "
            "lost. Was it killed for memory? Continue with 'flashdex train --resume "
            f"{self.ledger.path.parent}', or judge in the loop with train.judge=inline."
        )

    def close(self, *, wait: bool = True) -> None:
        """See ``Judging.close``."""
        try:
            if wait:
                self.collect(wait=True)
        finally:
            self._tasks.put(None)
            self._process.join(_ALIVE_S if wait else 0.0)
            if self._process.is_alive():
                self._process.terminate()


def _judge(
    order: JudgeOrder,
    start: Callable[[JudgeOrder], tuple[Ledger, AttemptMaker]],
    tasks: Any,
    answers: Any,
) -> None:
    """Body of the process: episodes in, lines out, until None or the parent's end."""
    import signal

    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the loop ends it in order
    torch.set_num_threads(1)
    parent = os.getppid()
    try:
        ledger, maker = start(order)
        while (task := _next(tasks, parent)) is not None:
            episode, wall_s = task
            attempt = maker.make(episode)
            ledger.record(attempt, env_steps=episode.env_steps, wall_s=wall_s)
            answers.put(ledger.last_line)
    except Exception as error:
        answers.put(error)
        raise


def _next(tasks: Any, parent: int) -> tuple[Episode, float] | None:
    """Wait for a task; None when there will be no more."""
    while os.getppid() == parent:
        try:
            return tasks.get(timeout=_ALIVE_S)
        except queue.Empty:
            continue
    return None
