"""Runs of the search: motions over processes, what they find in the run's ledger."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import time
from collections.abc import Collection
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.metrics.tally import is_unmoved, miss_distance
from flashdex.recipe import SearchRecipe, dump_recipe, expect_kind
from flashdex.rollouts.ledger import Ledger, read_ledger
from flashdex.rollouts.rollout import OF_SEARCH
from flashdex.search.config import SearchConfig
from flashdex.search.simulate import make_simulator
from flashdex.system.children import spawning_pool
from flashdex.system.files import RunHold, own_file
from flashdex.system.run_files import (
    MISSES,
    STARTS,
    miss_name,
    new_run,
    refuse_old_run,
    reported,
    resumed_run,
)
from flashdex.training.build import RunBuilder
from flashdex.training.logging import MetricLog, check_writers
from flashdex.training.run_dir import load_run_recipe
from flashdex.training.session import (
    SIGNAL,
    StopSignals,
    begin_session,
    end_session,
    interruptible,
)
from flashdex.training.tasks.planning import Found, Order, open_worker, work
from flashdex.training.tasks.source import (
    Source,
    forget_source,
    read_source,
    take_over,
)
from flashdex.training.tasks.tracking import TrackingTask
from flashdex.training.trainer import Progress

_LOG = logging.getLogger(__name__)
WAIT_S = 0.5  # between looks at signals


def search(
    recipe: SearchRecipe, overrides: Collection[str] = (), source: Path | None = None
) -> Path:
    """Search for the motions of a recipe from the beginning; return the run directory.

    Args:
        recipe: composed with ``task=search``.
        overrides: ``key=value`` words it was composed with, for the run's records.
        source: run to go on from: what it converted is left out, and a motion begins
            at its nearest miss.

    Raises:
        RunError: the folder already holds a run, or ``source`` is one of other things.
    """
    recipe = recipe.in_action_space()
    named = f"runs/{recipe.name}-search-s{recipe.seed}"
    run_dir = Path(recipe.run_dir or named)
    refuse_old_run(run_dir)
    check_writers(recipe)
    task = _make_task(recipe)
    prepare = forget_source
    if source is not None:
        found = read_source(source, recipe, task.contents)
        prepare = partial(take_over, source, found)
    with new_run(run_dir, dump_recipe(recipe), prepare) as hold:
        return _run(task, hold, list(overrides))


def resume_search(run: str | Path) -> Path:
    """Continue a search where it stopped: what its ledger holds is not done again.

    Raises:
        RunError: another process is at it, or the run is of another kind.
    """
    run_dir = Path(run)
    recipe = expect_kind(load_run_recipe(run_dir), SearchRecipe, where=str(run_dir))
    check_writers(recipe)
    with resumed_run(run_dir) as hold:
        task = _make_task(recipe)
        task.check_inputs(run_dir)
        return _run(task, hold, [])


def _make_task(recipe: SearchRecipe) -> TrackingTask:
    make_simulator(recipe.search.engine, recipe.physics)  # here it says what is missing
    with interruptible():
        return TrackingTask(RunBuilder.from_recipe(recipe))


def _run(task: TrackingTask, hold: RunHold, overrides: list[str]) -> Path:
    run_dir, why = hold.path, "error"
    source = Source.read(run_dir)
    with reported(run_dir):
        found = expect_kind(task.recipe, SearchRecipe, where=str(run_dir)).search
        on_gpu = found.engine == "warp" and torch.cuda.is_available()
        ledger = task.open_ledger(run_dir, source="search", on_gpu=on_gpu)
        done = ledger.newest.get("env_steps", 0)
        start = begin_session(run_dir, env_steps=done, wall_s=0.0, overrides=overrides)
        ledger.adopt(wall_s=start.wall_s)
        log = MetricLog(run_dir, task.recipe)
        session = _Session(task, ledger, log, hold, source, start.run, start.wall_s)
        try:
            why = session.run()
        finally:
            log.close()
            counters = {"env_steps": session.env_steps, "wall_s": session.wall_s}
            end_session(run_dir, why, **counters)
    _LOG.info("ended after %.0f core-seconds: %s", session.core_s, why)
    return run_dir


@dataclass
class _Progress:
    """What has been tried of one motion."""

    rung: int = -1  # the last one that was tried
    core_s: float = 0.0
    robust_s: float = 0.0  # of these, by the robust ladder
    miss: tuple[bool, bool, float] = (True, True, float("inf"))  # how far from a pass
    has_start: bool = False  # a miss of another run, not tried yet


@dataclass
class _Session:
    """One session of a search; the workers plan, this process keeps the files."""

    task: TrackingTask
    ledger: Ledger
    log: MetricLog
    hold: RunHold
    source: Source  # the run before it
    run_id: str
    wall_s: float  # of the run when the session began, then so far
    env_steps: int = 0
    core_s: float = 0.0
    motions: dict[str, _Progress] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.recipe = expect_kind(self.task.recipe, SearchRecipe, where="search")
        self.search: SearchConfig = self.recipe.search
        self.rungs = self.search.rungs
        self.names = self.task.builder.bank.names
        self.motions = {name: _Progress() for name in self.names}
        for name in self.source.starts.keys() & self.motions.keys():
            miss = miss_distance(self.source.starts[name])
            self.motions[name] = _Progress(miss=miss, has_start=True)
        for line in read_ledger(self.ledger.path):
            if line["motion"] in self.motions:
                self._note(line)
        self._began = time.monotonic() - self.wall_s

    def _note(self, line: dict[str, Any]) -> None:
        """Count an attempt: what it cost, and how near it came."""
        one = self.motions[line["motion"]]
        distance, spent = miss_distance(line), line.get("attempt_s", 0.0)
        rung = line.get("rung", -1)
        # what a start came to may be worse than it: then playback is tried as well
        if not one.has_start or distance <= one.miss:
            one.rung = max(one.rung, rung)
        one.has_start = False
        one.miss = min(one.miss, distance)
        one.core_s += spent
        self.core_s += spent
        if rung >= self.search.num_plain:
            one.robust_s += spent
        self.env_steps = max(self.env_steps, line["env_steps"])

    def _next(self, busy: set[str]) -> Order | None:
        """The cheapest rung that is left, of it the motion that came nearest."""
        found = []
        for row, name in enumerate(self.names):
            one, before = self.motions[name], self.ledger.conversions.get(name)
            if name in self.source.converted or name in busy:
                continue
            if before is None or is_unmoved(before):
                rung, last = one.rung + 1, self.search.num_plain
                near, spent = one.miss, one.core_s >= self.search.budget_s
            else:
                rung, last = max(one.rung + 1, self.search.num_plain), len(self.rungs)
                near = (False, False, -(before.get("survived") or 0.0))
                spent = (
                    one.robust_s >= self.search.robust_budget_s
                    or before.get("verdict") == "robust"
                    or not self.recipe.train.certify  # then no proof tells plans apart
                )
            if rung < last and not spent:
                found.append((rung, near, row))
        if not found:
            return None
        rung, _, row = min(found)
        return self._order(row, rung)

    def _order(self, row: int, rung: int) -> Order:
        """A pass, from the nearest miss that is worth it.

        The first begins at that of the run before; later ones at the run's own where
        the object moved in it, others at playback, which then comes further.
        """
        name, folder = self.names[row], STARTS
        line = self.source.starts.get(name)
        if not self.motions[name].has_start:
            folder, line = MISSES, self.ledger.misses.get(name)
            if line is None or is_unmoved(line) or rung == 0:
                line = None
        if line is None:
            return Order(row, rung)
        path = own_file(self.hold.path, miss_name(name, folder))
        return Order(row, rung, path, line["miss_sha256"])

    def _end_reason(self) -> str:
        limit = self.recipe.train.wall_limit_s
        if limit is not None and self.wall_s > limit:
            return "wall_limit_s"
        return ""

    def run(self) -> str:
        """Search until nothing is left to try, or something ends it; return why."""
        count = self.search.workers or len(os.sched_getaffinity(0))
        if self.search.engine == "warp":  # its worlds fill the device
            count = 1
        count = max(1, min(count, len(self.names)))
        progress = Progress(
            self.recipe.name,
            total=len(set(self.names) - self.source.converted.keys()),
            done=len(self.ledger.done),
            unit="motion",
        )
        provenance = {**self.task.provenance, "run": self.run_id}
        pool = spawning_pool(count, open_worker, self._worker_recipe(), provenance)
        flying: dict[Future[Found], str] = {}
        try:
            with StopSignals() as stop:
                while True:
                    why = SIGNAL if stop.requested else self._end_reason()
                    while not why and len(flying) < count:
                        order = self._next(set(flying.values()))
                        if order is None:
                            break
                        flying[pool.submit(work, order)] = self.names[order.row]
                    if why or not flying:
                        return why or "nothing left to try"
                    done, _ = wait(flying, WAIT_S, FIRST_COMPLETED)
                    for future in done:
                        del flying[future]
                        self._take(future.result(), progress)
        except BrokenProcessPool as error:
            raise RunError(
                "a process of the search has died. Was it killed for memory? Use fewer "
                "with search.workers=1, and go on with 'flashdex search --resume "
                f"{self.hold.path}'."
            ) from error
        finally:
            progress.bar.close()
            _end(pool)

    def _worker_recipe(self) -> SearchRecipe:
        """The recipe with the library that is in use: workers prepare nothing."""
        library = str(self.task.builder.library.path)
        motions = dataclasses.replace(self.recipe.motions, library=library)
        return dataclasses.replace(self.recipe, motions=motions)

    def _take(self, found: Found, progress: Progress) -> None:
        """Write what a worker found; the run's clock and counters go on."""
        self.hold.check()
        self.wall_s = time.monotonic() - self._began
        self.env_steps += found.simulated
        rollout = found.rollout
        rollout.env_steps = self.env_steps
        spent = {"rung": found.order.rung, "attempt_s": round(found.core_s, 3)}
        if found.order.start is not None:
            spent["start"] = found.order.start_sha256
        said = {**json.loads(rollout.provenance), OF_SEARCH: spent}
        rollout.provenance = json.dumps(said)
        proof = found.certificate and found.certificate.counted(rollout)
        line, _ = self.ledger.record(rollout, wall_s=self.wall_s, certificate=proof)
        self._note(line)
        hours = self.wall_s / 3600
        self.log.write(
            {
                "env_steps": self.env_steps,
                "hours": hours,
                "search/core_s": self.core_s,
                "search/rung": found.order.rung,
                **self.ledger.metrics(hours),
            }
        )
        progress.bar.n = len(self.ledger.done)
        note = f"{self.ledger.note}, {self.core_s:.0f} core-s"
        progress.show(note, done=progress.bar.n, wall_s=self.wall_s)


def _end(pool: ProcessPoolExecutor) -> None:
    """End the workers at once: what they are at is done again after a resume."""
    for process in list((pool._processes or {}).values()):
        process.kill()  # they ignore what ends the search, and write nothing
    pool.shutdown(wait=True, cancel_futures=True)
