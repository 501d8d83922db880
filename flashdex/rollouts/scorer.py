"""Scoring attempts: in the loop, or in a process beside it.

Building, scoring, storing and certifying a rollout takes the host ten to a thousand
milliseconds. On the cpu that is little against the physics; a GPU would stand still.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from flashdex.errors import FlashdexError, RunError
from flashdex.rollouts.build import RolloutBuilder
from flashdex.rollouts.ledger import Ledger
from flashdex.rollouts.recorder import Episode
from flashdex.system.children import spawning_pool

if TYPE_CHECKING:
    from flashdex.recipe import Recipe

MAX_PENDING = 512  # episodes in line, a megabyte each; then the loop waits


class InlineScorer:
    """Scores at once."""

    pending = 0  # episodes that are not scored yet

    def __init__(self, ledger: Ledger, builder: RolloutBuilder) -> None:
        self.ledger, self.builder = ledger, builder
        self._converted: list[str] = []

    def submit(self, episode: Episode, wall_s: float) -> dict[str, Any]:
        """Score a finished episode at so many seconds of the run; return its line."""
        rollout = self.builder.build(episode)
        line, is_done = self.ledger.record(rollout, wall_s=wall_s)
        if is_done:
            self._converted.append(rollout.motion)
        return line

    def collect(self, *, wait: bool = False) -> list[str]:
        """Motions that are done since the last call."""
        converted, self._converted = self._converted, []
        return converted

    def close(self, *, wait: bool = True) -> None:
        """Nothing is in line."""


@dataclass(frozen=True)
class ScorerSpec:
    """What the scoring process builds its own scorer from."""

    recipe: Recipe  # of the run, with the library that is in use
    run_dir: Path
    made_by: dict[str, Any]  # engine, versions and hardware of the states
    provenance: dict[str, str]  # stored with every rollout
    trivial: dict[str, list[str]]  # motions that a baseline already passes
    on_gpu: bool = False  # a GPU steps the physics


MakeScorer = Callable[[ScorerSpec], InlineScorer]


class ProcessScorer:
    """Scores in a process of its own, which writes all lines and rollouts.

    ``ledger`` follows what the process writes; it must write nothing meanwhile. The
    process first runs ``make`` on ``spec``.
    """

    def __init__(self, ledger: Ledger, spec: ScorerSpec, make: MakeScorer) -> None:
        self.ledger = ledger
        self._pool = spawning_pool(1, live_with_parent)  # one: lines keep their order
        self._opened: Future[None] | None = self._pool.submit(_open, spec, make)
        self._line: deque[Future[dict[str, Any]]] = deque()

    @property
    def pending(self) -> int:
        """Episodes that are not scored yet."""
        return len(self._line)

    def submit(self, episode: Episode, wall_s: float) -> None:
        """Hand over a finished episode at so many seconds of the run."""
        try:
            self._line.append(self._pool.submit(_score, episode, wall_s))
        except BrokenProcessPool as error:
            raise self._died() from error

    def collect(self, *, wait: bool = False) -> list[str]:
        """Motions that are done since the last call.

        ``wait`` until all episodes are scored and their lines written.

        Raises:
            OSError: a file could not be written.
            RunError: the scoring process has died.
        """
        converted = []
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
            if self.ledger.count(line):
                converted.append(line["motion"])
        return converted

    def _died(self) -> RunError:
        return RunError(
            f"the process that judges attempts has died with {self.pending} of them in "
            "line; those are lost. Was it killed for memory? (A script of yours that "
            "trains needs an 'if __name__ == \"__main__\":'.) Continue with 'flashdex "
            f"train --resume {self.ledger.path.parent}', or judge in the loop with "
            "train.judge=inline."
        )

    def close(self, *, wait: bool = True) -> None:
        """End; ``wait`` to score what is in line first."""
        try:
            if wait:
                self.collect(wait=True)
        finally:
            self._pool.shutdown(wait=wait, cancel_futures=True)


Scorer = InlineScorer | ProcessScorer
"""Takes episodes in and says which motions converted, in the order of episodes."""

_opened: list[InlineScorer] = []  # of the scoring process


def live_with_parent() -> None:
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


def _open(spec: ScorerSpec, make: MakeScorer) -> None:
    torch.set_num_threads(1)
    try:
        _opened.append(make(spec))
    except FlashdexError as error:
        raise RunError(str(error)) from None  # others may not travel between processes


def _score(episode: Episode, wall_s: float) -> dict[str, Any]:
    return _opened[0].submit(episode, wall_s)
