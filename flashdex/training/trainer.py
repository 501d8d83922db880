"""The training loop: act, learn beside the physics, store, log, save."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.errors import RunError
from flashdex.recipe import dump_recipe
from flashdex.replay.disk import ReplayLog
from flashdex.system.files import RunHold
from flashdex.system.run_files import METRICS
from flashdex.system.tensors import first_non_finite
from flashdex.training.checkpoint import save_checkpoint
from flashdex.training.guard import (
    GradientGuard,
    NonFiniteError,
    numeric_errors,
    stop_with_dump,
)
from flashdex.training.logging import MetricLog
from flashdex.training.session import SIGNAL, SessionStart, StopSignals
from flashdex.training.stats import RunningStats
from flashdex.training.tasks.base import Task

_LOG = logging.getLogger(__name__)
PLAIN_LOG_S = 30.0  # s between progress lines where there is no terminal


class Progress:
    """A bar of env steps, or of what else is counted; a log without a terminal."""

    def __init__(self, name: str, *, total: int, done: int, unit: str = "step") -> None:
        self.total, self.unit = total, unit
        # Without a terminal tqdm would fill the log with carriage returns.
        self.bar = tqdm(
            total=total,
            initial=done,
            unit=unit,
            unit_scale=True,
            desc=name,
            disable=None,
            dynamic_ncols=True,
        )
        self._last_line = time.monotonic()

    def show(self, note: str, *, done: int, wall_s: float) -> None:
        """Show what was achieved, by so many units."""
        self.bar.set_postfix_str(note)
        now = time.monotonic()
        if self.bar.disable and now - self._last_line >= PLAIN_LOG_S:
            self._last_line = now
            _LOG.info(
                "%d of %d %ss, %s, %.0f s", done, self.total, self.unit, note, wall_s
            )


class BackgroundWorker:
    """Runs one piece of work while the body of a ``with`` block runs.

    The work and the block must share nothing that either changes; then the outcome is
    that of the work done first and the block after it, which is what ``threaded=False``
    does.

    Example:
        >>> done = []
        >>> with BackgroundWorker(threaded=True).run(lambda: done.append("work")):
        ...     pass
        >>> done
        ['work']
    """

    def __init__(self, *, threaded: bool) -> None:
        self._pool: ThreadPoolExecutor | None = None
        if threaded:
            self._pool = ThreadPoolExecutor(1, "learner")
            # A thread takes the number that is set when it first asks, and the block
            # may have lowered it for itself just then: ask now.
            self._pool.submit(torch.get_num_threads).result()

    @contextmanager
    def run(self, work: Callable[[], None]) -> Iterator[None]:
        """Do ``work`` beside the block; both have ended when the block is left.

        Raises:
            BaseException: what ``work`` raised, unless the block raised first.
        """
        if self._pool is None:
            work()
            yield
            return
        future = self._pool.submit(work)
        try:
            yield
        except BaseException:
            future.exception()  # waits; the block's own error is the one to show
            raise
        future.result()

    def close(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown()


class Trainer:
    """Owns the counters of a run and performs vector steps; the task has begun."""

    def __init__(
        self,
        task: Task,
        run_dir: Path,
        learner: Learner,
        log: MetricLog,
        *,
        start: SessionStart,
        replay: ReplayLog | None = None,
        hold: RunHold | None = None,
    ) -> None:
        self.task, self.recipe, self.env = task, task.recipe, task.env
        self.run_dir, self.learner, self.log = run_dir, learner, log
        self.start, self.replay, self.hold = start, replay, hold
        self.stats, self.guard = RunningStats(), GradientGuard()
        self.stop = StopSignals()
        self.learns_beside = task.updates_during_step and learner.is_off_policy
        # A device takes its work in one line: a second thread would only stand by it.
        overlap = self.learns_beside and self.recipe.train.overlap
        self.worker = BackgroundWorker(threaded=overlap and self.env.is_host_device)
        self.env_steps = start.env_steps
        self.vector_steps = 0
        self._saved_at = start.env_steps
        self._logged = (start.env_steps, task.num_results)
        self._last_record: dict[str, float] = {}
        self._began = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Seconds of this run, earlier sessions included."""
        return self.start.wall_s + time.monotonic() - self._began

    def run(self) -> str:
        """Train until the budget, a limit or a signal ends it; return why.

        Raises:
            RunError: something was not finite, or the run directory cannot be written.
        """
        try:
            with self.stop, self.guard:
                why = self._loop()
                lost = self.task.settle(self)
                self.task.finish(self, why)
                self._write_log()
                self.save()
                if lost is not None:
                    raise lost
        except NonFiniteError as error:
            raise stop_with_dump(
                self.run_dir,
                str(error),
                recipe=self.recipe,
                learner=self.learner,
                env_steps=self.env_steps,
                metrics=self._last_record,
            ) from error
        except OSError as error:
            raise RunError(
                f"{self.run_dir}: cannot be written ({error}). The run stopped; what "
                "is stored is whole. Make room, then continue it with 'flashdex train "
                f"--resume {self.run_dir}'."
            ) from error
        return why

    def reset(self) -> TensorDictBase:
        """Begin new episodes everywhere; what the first step starts from."""
        td = self.env.reset()
        self.task.after_reset()
        return td

    def _loop(self) -> str:
        train, total = self.recipe.train, self.recipe.total_env_steps
        td = self.reset()
        self._last_log = last_save = time.monotonic()
        progress = Progress(self.recipe.name, total=total, done=self.env_steps)
        try:
            while not (why := self._end_reason()):
                td = self.vector_step(td)
                progress.bar.update(self.env.num_envs)
                now = time.monotonic()
                if self.task.record_due or now - self._last_log >= train.log_every_s:
                    self._write_log()
                    note = self.task.note
                    progress.show(note, done=self.env_steps, wall_s=self.wall_s)
                if now - last_save >= train.checkpoint_every_s:
                    self._try_to_save()
                    last_save = time.monotonic()
        finally:
            progress.bar.close()
            self.worker.close()
        return why

    def vector_step(self, td: TensorDictBase) -> TensorDictBase:
        """One step of all worlds, with the updates that belong to it."""
        self._look_after_folder()
        with self.stats.time("act"):
            action = self.learner.act(self._state_of(td))
            self.env.put_action(td, action)
        # The updates read rows and write weights, the step does neither.
        with self.worker.run(self._update) if self.learns_beside else nullcontext():
            with self.stats.time("env"):
                td = self.env.step(td)
            after = td.get("next")
            self.env_steps += self.env.num_envs
            self.vector_steps += 1
            self.task.after_physics(self, action, after[keys.DONE])
        with self.stats.time("remember"):
            self._process_step(td, action)
        if not self.learns_beside:
            self._update()
        self.task.after_step(self, after)
        with self.stats.time("reset"):
            return self._advance(td, after[keys.DONE])

    def _look_after_folder(self) -> None:
        """Before anything is written: the folder may have been moved meanwhile."""
        if self.hold is not None:
            self.hold.check()

    def _advance(self, td: TensorDictBase, done: Tensor) -> TensorDictBase:
        if self.env.is_host_device and not done.any():
            return step_mdp(td)
        td = self.env.reset_worlds(done.squeeze(-1))
        self.task.after_reset()
        return td

    def _state_of(self, td: TensorDictBase) -> TensorDictBase:
        """What the learner reads of a state, on its device."""
        return td.select(*self.task.state_keys).to(self.learner.device)

    def _process_step(self, td: TensorDictBase, action: Tensor) -> None:
        device, after = self.learner.device, td.get("next")
        self.learner.process_step(
            self._state_of(td),
            action.to(device),
            self.task.rewards(after).to(device),
            self._state_of(after),
            after[keys.TERMINATED].to(device),
            after[keys.DONE].to(device),
        )

    def _update(self) -> None:
        for _ in range(self.learner.num_updates()):
            with self.stats.time("update"), numeric_errors(self.learner):
                self.stats.add_update(self.learner.update())

    def _end_reason(self) -> str:
        limit = self.recipe.train.wall_limit_s
        if self.env_steps >= self.recipe.total_env_steps:
            return "budget"
        if self.stop.requested:
            return SIGNAL
        if limit is not None and self.wall_s > limit:
            return "wall_limit_s"
        return self.task.end_reason()

    def _write_log(self) -> None:
        counters, now = (self.env_steps, self.task.num_results), time.monotonic()
        if counters == self._logged and not self.task.record_due:
            return  # a clean stop has just logged, or a resume has nothing left to do
        seconds = max(now - self._last_log, 1e-9)
        record = {
            "env_steps": self.env_steps,
            "env_steps_lost": self.start.lost,
            "hours": self.wall_s / 3600,
            "updates": self.learner.updates,
            "buffer/rows": self.learner.num_rows,
            "buffer/dropped": self.learner.num_dropped,
            **self.task.metrics(self),
            **self.stats.pop(seconds, self.env.num_envs),
        }
        self._last_record = {k: float(v) for k, v in record.items()}
        self.guard.check()
        if bad := first_non_finite(self._last_record):
            raise NonFiniteError(bad)
        self.log.write(record)
        self._last_log = time.monotonic()
        self._logged = (self.env_steps, self.task.num_results)

    def _try_to_save(self) -> None:
        """Save; a disk that is full may have room again at the next time."""
        try:
            self.save()
        except OSError as error:
            _LOG.warning("no checkpoint this time, the run goes on: %s", error)

    def save(self) -> None:
        """Write a checkpoint, unless there is one of this very step.

        Raises:
            NonFiniteError: what would be stored is not finite.
            OSError: it cannot be written.
        """
        if self.env_steps == self._saved_at:
            return
        self.guard.check()
        self._look_after_folder()
        lost = self.task.settle(self)
        state = self.state_dict()
        if bad := first_non_finite(state["learner"]):
            raise NonFiniteError(bad)
        keep = self.recipe.train.keep_checkpoints
        save_checkpoint(self.run_dir, state, keep=keep, replay=self.replay)
        self._saved_at = self.env_steps
        if lost is not None:
            raise lost

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs, tensors and plain values only."""
        return {
            "env_steps": self.env_steps,
            "vector_steps": self.vector_steps,
            "wall_s": self.wall_s,
            "env_steps_lost": self.start.lost,
            "learner": self.learner.state_dict(),
            "torch_rng": torch.get_rng_state(),
            "recipe": dump_recipe(self.recipe),
            "wandb_id": self.log.wandb_id,
            "records": self.log.lines.count,
            "run": self.start.run,
            **self.task.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore all of ``state_dict`` but the learner, which is restored already."""
        self.vector_steps = state.get("vector_steps", 0)
        if self.log.lines.count < state.get("records", 0):
            _LOG.warning(
                "%s is shorter than at the checkpoint: %d records are missing",
                self.run_dir / METRICS,
                state["records"] - self.log.lines.count,
            )
        self.task.load_state_dict(state)
        if "torch_rng" in state:
            torch.set_rng_state(state["torch_rng"])

    def close(self, *, wait: bool) -> None:
        """Close task and log; ``wait`` finishes what is in line first."""
        try:
            self.task.close(wait=wait)
        finally:
            self.log.close()
