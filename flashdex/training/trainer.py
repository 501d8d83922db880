"""The training loop: act, learn while the physics steps, judge, remember, log."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.envs.mdp.assist import AssistEpoch
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import RunError
from flashdex.modules.layers import restore_generator
from flashdex.recipe import Recipe, dump_recipe
from flashdex.replay.disk import ReplayLog
from flashdex.rollouts.ledger import Ledger
from flashdex.rollouts.recorder import Episode, EpisodeRecorder
from flashdex.rollouts.scorer import Scorer
from flashdex.training.checkpoint import save_checkpoint
from flashdex.training.guard import (
    GradientGuard,
    NonFiniteError,
    first_non_finite,
    numeric_errors,
)
from flashdex.training.logging import MetricLog
from flashdex.training.nan_dump import stop_with_dump
from flashdex.training.session import SIGNAL, Start
from flashdex.training.stats import RunningStats
from flashdex.training.stop_signals import StopSignals

_ROOM = {
    "contacts": "physics.nconmax",
    "constraints": "physics.njmax",
}


def make_record(
    *,
    env_steps: int,
    lost: int,
    wall_s: float,
    env: TrackingEnv,
    learner: Learner,
    ledger: Ledger,
    scorer: Scorer,
) -> dict[str, float]:
    """What a log record says besides the running means.

    Args:
        env_steps: counter of the run.
        lost: env steps lost to crashes.
        wall_s: seconds of the run, earlier sessions included.
        env: for the assist and the engine's overflow, which is read and cleared.
        learner: for updates and buffer.
        ledger: for conversions.
        scorer: for the attempts in line.
    """
    record: dict[str, float] = {
        "env_steps": env_steps,
        "env_steps_lost": lost,
        "hours": wall_s / 3600,
        "updates": learner.updates,
        **ledger.metrics(wall_s / 3600),
        "convert/pending": scorer.pending,
        "buffer/rows": learner.num_rows,
        "buffer/dropped": float(getattr(learner, "num_dropped", 0)),
        "assist/level": env.assist.upper[0] if env.assist is not None else 0.0,
    }
    for kind, worlds in env.physics.take_overflow().items():
        record[f"physics/overflow_{kind}"] = worlds
        _LOG.warning(
            "%d of %d worlds ran out of room for %s: the engine dropped some, so "
            "these worlds were wrong for a while%s",
            worlds,
            env.num_envs,
            kind,
            f". Raise {_ROOM[kind]}" if kind in _ROOM else "",
        )
    return record


PLAIN_LOG_S = 30.0  # s between progress lines where there is no terminal


class Progress:
    """Shows env steps and conversions.

    Args:
        name: of the recipe.
        total: env steps of the run.
        done: of them, those of earlier sessions.
    """

    def __init__(self, name: str, *, total: int, done: int) -> None:
        self.total = total
        # Without a terminal tqdm would fill the log with carriage returns.
        self._bar = tqdm(
            total=total,
            initial=done,
            unit="step",
            unit_scale=True,
            desc=name,
            disable=None,
            dynamic_ncols=True,
        )
        self._last_line = time.monotonic()

    def update(self, steps: int) -> None:
        """Advance the bar."""
        self._bar.update(steps)

    def show(self, note: str, *, env_steps: int, wall_s: float) -> None:
        """Show a note beside the bar, or log a line if the last one is old enough.

        Args:
            note: what was achieved.
            env_steps: of the run.
            wall_s: seconds of the run.
        """
        self._bar.set_postfix_str(note)
        now = time.monotonic()
        if self._bar.disable and now - self._last_line >= PLAIN_LOG_S:
            self._last_line = now
            _LOG.info(
                "%d of %d env steps, %s, %.0f s", env_steps, self.total, note, wall_s
            )

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()


class Alongside:
    """Runs one piece of work while the body of a ``with`` block runs.

    The work and the block must share nothing that either changes; then the outcome is
    that of the work done first and the block after it, whichever is on.

    Args:
        threaded: False does just that, one after the other.

    Example:
        >>> done = []
        >>> with Alongside(threaded=True).run(lambda: done.append("work")):
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
    def run(self, work: Callable[[], None] | None) -> Iterator[None]:
        """Do ``work`` beside the block; both have ended when the block is left.

        Args:
            work: what to do; None is nothing.

        Raises:
            BaseException: what ``work`` raised, unless the block raised first.
        """
        if work is None:
            yield
            return
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


def loop_state(trainer: Trainer) -> dict[str, Any]:
    """Everything a resumed run needs, tensors and plain values only.

    The samplers hold nothing but what the conversions say, and those are in files.

    Args:
        trainer: between two vector steps, its attempts all judged.
    """
    assist = trainer.env.assist
    return {
        "env_steps": trainer.env_steps,
        "vector_steps": trainer.vector_steps,
        "wall_s": trainer.wall_s,
        "env_steps_lost": trainer.start.lost,
        "learner": trainer.learner.state_dict(),
        "assist": None if assist is None else assist.state_dict(),
        "assist_epoch": trainer.assist_epoch.state_dict(),
        "env_generator": trainer.env.generator.get_state(),
        "torch_rng": torch.get_rng_state(),
        "ledger_bytes": trainer.ledger.num_bytes,
        "recipe": dump_recipe(trainer.recipe),
        "wandb_id": trainer.log.wandb_id,
    }


def load_loop_state(trainer: Trainer, state: dict[str, Any]) -> None:
    """Restore all of ``loop_state`` but the learner, which is restored already.

    Args:
        trainer: of a new session.
        state: from ``loop_state``.
    """
    trainer.vector_steps = state["vector_steps"]
    trainer.assist_epoch.load_state_dict(state["assist_epoch"])
    if trainer.env.assist is not None and state["assist"] is not None:
        trainer.env.assist.load_state_dict(state["assist"])
        trainer.env.redraw_assist()
    restore_generator(trainer.env.generator, state["env_generator"])
    torch.set_rng_state(state["torch_rng"])


_LOG = logging.getLogger(__name__)


class Trainer:
    """Owns the counters of a run and performs vector steps.

    Args:
        recipe: validated recipe.
        run_dir: run directory.
        env: tracking environment.
        learner: acts and learns.
        ledger: what was achieved.
        scorer: scores attempts for the ledger.
        log: metric writers.
        start: where the session begins.
        replay: stores replay rows with the checkpoints, or None.
    """

    def __init__(
        self,
        recipe: Recipe,
        run_dir: Path,
        env: TrackingEnv,
        learner: Learner,
        ledger: Ledger,
        scorer: Scorer,
        log: MetricLog,
        *,
        start: Start,
        replay: ReplayLog | None = None,
    ) -> None:
        self.recipe, self.run_dir, self.env = recipe, run_dir, env
        self.learner, self.ledger, self.log = learner, ledger, log
        self.start, self.replay = start, replay
        self.scorer, self.recorder = scorer, EpisodeRecorder(env)
        self.stats = RunningStats()
        self.assist_epoch = AssistEpoch(env.terms.gates)
        self.guard = GradientGuard()
        # A device takes its work in one line: a second thread would only stand by it.
        self.alongside = Alongside(threaded=recipe.train.overlap and env.is_host_device)
        self.stop = StopSignals()
        self.env_steps = start.env_steps
        self.vector_steps = 0
        self._saved_at = start.env_steps
        self._logged = (start.env_steps, ledger.num_attempts)
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
        for name in self.ledger.conversions:
            self._mark_converted(name)
        try:
            with self.stop, self.guard:
                why = self._loop()
                lost = self._settle()
                self._write_log()
                self.save()
                if lost is not None:
                    raise lost
        except NonFiniteError as error:
            raise self._dump(str(error)) from error
        except OSError as error:
            raise RunError(
                f"{self.run_dir}: cannot be written ({error}). The run stopped; what "
                "is stored is whole. Make room, then continue it with 'flashdex train "
                f"--resume {self.run_dir}'."
            ) from error
        return why

    def _loop(self) -> str:
        train, total = self.recipe.train, self.recipe.total_env_steps
        td = self.env.reset()
        self.recorder.record_start()
        self._last_log = last_save = time.monotonic()
        bar = Progress(self.recipe.name, total=total, done=self.env_steps)
        try:
            while not (why := self._end_reason()):
                td = self.vector_step(td)
                bar.update(self.env.num_envs)
                now = time.monotonic()
                if now - self._last_log >= train.log_every_s:
                    self._write_log()
                    note = self.ledger.note
                    bar.show(note, env_steps=self.env_steps, wall_s=self.wall_s)
                if now - last_save >= train.checkpoint_every_s:
                    self._try_to_save()
                    last_save = time.monotonic()
        finally:
            bar.close()
            self.alongside.close()
        return why

    def vector_step(self, td: TensorDictBase) -> TensorDictBase:
        """One step of all worlds, with the updates that belong to it."""
        with self.stats.time("act"):
            action = self.learner.act(td.to(self.learner.device))
            self.env.put_action(td, action)
        # The updates read rows and write weights, the step does neither.
        beside = self._learn if self.learner.is_off_policy else None
        with self.alongside.run(beside):
            with self.stats.time("env"):
                td = self.env.step(td)
            after = td.get("next")
            self.env_steps += self.env.num_envs
            self.vector_steps += 1
            terminated, done = after[keys.TERMINATED], after[keys.DONE]
            with self.stats.time("judge"):
                self._judge(self.recorder.record_step(action, done, self.env_steps))
        with self.stats.time("remember"):
            self._remember(td, action)
        if not self.learner.is_off_policy:
            self._learn()
        judged = (self.env.last_step, done, terminated)
        self.stats.add_step(*judged)
        self.assist_epoch.step(self.env, *judged, self.vector_steps)
        with self.stats.time("reset"):
            return self._advance(td, done)

    def _advance(self, td: TensorDictBase, done: Tensor) -> TensorDictBase:
        if self.env.is_host_device and not done.any():
            return step_mdp(td)
        td = self.env.reset_worlds(done.squeeze(-1))
        self.recorder.record_start()
        return td

    def _remember(self, td: TensorDictBase, action: Tensor) -> None:
        device = self.learner.device
        after = td.get("next").to(device)
        self.learner.remember(
            td.exclude("next").to(device),
            action.to(device),
            torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1),
            after,
            after[keys.TERMINATED],
            after[keys.DONE],
        )

    def _judge(self, episodes: list[Episode], *, wait: bool = False) -> None:
        for episode in episodes:
            self.scorer.submit(episode, self.wall_s)
        for motion in self.scorer.collect(wait=wait):
            self._mark_converted(motion)

    def _settle(self) -> RunError | None:
        """Judge all attempts so far; what was learnt is not lost with the judge."""
        try:
            self._judge(self.recorder.finished(), wait=True)
        except RunError as error:
            return error
        return None

    def _mark_converted(self, name: str) -> None:
        row = self.env.bank.names.index(name)
        self.env.sampler.mark_converted(row)
        self.env.attempt_sampler.mark_converted(row)

    def _learn(self) -> None:
        for _ in range(self.learner.due()):
            with self.stats.time("update"), numeric_errors(self.learner):
                self.stats.add_update(self.learner.update())

    def _end_reason(self) -> str:
        train = self.recipe.train
        if self.env_steps >= self.recipe.total_env_steps:
            return "budget"
        if self.stop.requested:
            return SIGNAL
        if train.wall_limit_s is not None and self.wall_s > train.wall_limit_s:
            return "wall_limit_s"
        everything = self.ledger.num_converted == len(self.ledger.names)
        if train.stop_when_all_converted and everything:
            return "all converted"
        return ""

    def _write_log(self) -> None:
        counters, now = (self.env_steps, self.ledger.num_attempts), time.monotonic()
        if counters == self._logged:
            return  # a clean stop has just logged, or a resume has nothing left to do
        seconds = max(now - self._last_log, 1e-9)
        record = make_record(
            env_steps=self.env_steps,
            lost=self.start.lost,
            wall_s=self.wall_s,
            env=self.env,
            learner=self.learner,
            ledger=self.ledger,
            scorer=self.scorer,
        )
        record.update(self.stats.pop(seconds, self.env.num_envs))
        self._last_record = {k: float(v) for k, v in record.items()}
        self.guard.check()
        if bad := first_non_finite(self._last_record):
            raise NonFiniteError(bad)
        self.log.write(record)
        self._last_log, self._logged = now, counters

    def _dump(self, what: str) -> RunError:
        return stop_with_dump(
            self.run_dir,
            what,
            recipe=self.recipe,
            learner=self.learner,
            env_steps=self.env_steps,
            metrics=self._last_record,
        )

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
        lost = self._settle()
        state = self.state_dict()
        if bad := first_non_finite(state["learner"]):
            raise NonFiniteError(bad)
        keep = self.recipe.train.keep_checkpoints
        save_checkpoint(self.run_dir, state, keep=keep, replay=self.replay)
        self._saved_at = self.env_steps
        if lost is not None:
            raise lost

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs; see ``loop_state``."""
        return loop_state(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore all of ``state_dict`` but the learner, which is restored already."""
        load_loop_state(self, state)
