"""The loop on a stock environment: act, step, remember, learn, evaluate, log."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from flashdex.algorithms.flashsac import GymLearner
from flashdex.envs.gym import GymWorlds
from flashdex.errors import RunError
from flashdex.recipe import GymRecipe
from flashdex.replay.disk import ReplayLog
from flashdex.training.checkpoint import newest_checkpoint, save_checkpoint
from flashdex.training.evaluator import StoppedError, evaluate_recipe, observed
from flashdex.training.guard import (
    GradientGuard,
    NonFiniteError,
    first_non_finite,
    numeric_errors,
)
from flashdex.training.logging import MetricLog
from flashdex.training.session import SIGNAL, Start
from flashdex.training.stats import GymStats
from flashdex.training.stop_signals import StopSignals

_LOG = logging.getLogger(__name__)


class GymTrainer:
    """Owns the counters of a run and performs vector steps.

    Args:
        recipe: validated recipe.
        run_dir: run directory.
        learner: acts and learns; holds what a checkpoint gave it.
        log: metric writers.
        start: where this session begins.
        replay: files of the replay buffer.
    """

    def __init__(
        self,
        recipe: GymRecipe,
        run_dir: Path,
        learner: GymLearner,
        log: MetricLog,
        *,
        start: Start,
        replay: ReplayLog,
    ) -> None:
        self.recipe, self.run_dir = recipe, run_dir
        self.learner, self.log, self.replay = learner, log, replay
        self.start, self.env_steps = start, start.env_steps
        self.stats = GymStats(recipe.gym.num_envs)
        self._saved_at = self._logged_at = start.env_steps
        self._began = self._last_log = time.monotonic()
        self._stop = StopSignals()

    @property
    def wall_s(self) -> float:
        """Seconds of this run, earlier sessions included."""
        return self.start.wall_s + time.monotonic() - self._began

    def run(self) -> str:
        """Train until the budget, a limit or a signal ends it; return why.

        Raises:
            RunError: something was not finite, or the folder cannot be written.
        """
        recipe, config = self.recipe, self.recipe.gym
        # A resumed run goes on from fresh starts, not from those it began with.
        worlds = GymWorlds(
            config, num_envs=config.num_envs, seed=recipe.seed + self.env_steps
        )
        try:
            with self._stop, GradientGuard():
                why = self._loop(worlds)
                self._write_log()
                self.save()
        except NonFiniteError as error:
            raise self._not_finite(str(error)) from error
        except OSError as error:
            raise RunError(
                f"{self.run_dir}: cannot be written ({error}). Make room, then "
                f"continue it with 'flashdex train --resume {self.run_dir}'."
            ) from error
        finally:
            worlds.close()
        return why

    def _loop(self, worlds: GymWorlds) -> str:
        train = self.recipe.train
        observation = worlds.reset()
        self._last_log = last_save = time.monotonic()
        while not (why := self._end_reason()):
            observation = self.vector_step(worlds, observation)
            due = self._evaluation_due()
            if due or time.monotonic() - self._last_log >= train.log_every_s:
                self._write_log(evaluate=due)
            if time.monotonic() - last_save >= train.checkpoint_every_s:
                self._try_to_save()
                last_save = time.monotonic()
        return why

    def vector_step(self, worlds: GymWorlds, observation: Tensor) -> Tensor:
        """One step of all worlds, with the updates that belong to it.

        Args:
            worlds: training worlds.
            observation: before the step, (N, D).

        Returns:
            Observations of the next step, (N, D); new starts where an episode ended.
        """
        state = observed(observation)
        with self.stats.time("act"):
            action = self.learner.act(state)
        with self.stats.time("env"):
            step = worlds.step(action)
        self.env_steps += worlds.num_envs
        after = observed(step.observation)
        with self.stats.time("remember"):
            self.learner.remember(
                state, action, step.reward, after, step.terminated, step.done
            )
        self.stats.add_rewards(step.reward, step.terminated, step.done)
        for _ in range(self.learner.due()):
            with self.stats.time("update"), numeric_errors(self.learner):
                self.stats.add_update(self.learner.update())
        return worlds.reset_done(step.done) if step.done.any() else step.observation

    def _evaluation_due(self) -> bool:
        config = self.recipe.gym
        before = self.env_steps - config.num_envs
        every = config.eval_every_env_steps
        is_last = self.env_steps >= self.recipe.total_env_steps
        return is_last or self.env_steps // every > before // every

    def _end_reason(self) -> str:
        limit = self.recipe.train.wall_limit_s
        if self.env_steps >= self.recipe.total_env_steps:
            return "budget"
        if self._stop.requested:
            return SIGNAL
        return "wall_limit_s" if limit is not None and self.wall_s > limit else ""

    def _write_log(self, *, evaluate: bool = False) -> None:
        if self.env_steps == self._logged_at:
            return  # it was logged by time, or a resume has nothing left to do
        seconds = max(time.monotonic() - self._last_log, 1e-9)
        record: dict[str, Any] = {
            "env_steps": self.env_steps,
            "hours": self.wall_s / 3600,
            "updates": self.learner.updates,
            **self.stats.pop(seconds, self.recipe.gym.num_envs),
            "buffer/rows": self.learner.num_rows,
            "buffer/dropped": self.learner.num_dropped,
            "reward/scale": self.learner.agent.normalizer.denominator().item(),
        }
        if evaluate:
            with suppress(StoppedError):  # the record goes without it
                record |= self._evaluate()
        if bad := first_non_finite(record):
            raise NonFiniteError(bad)
        self.log.write(record)
        self._last_log, self._logged_at = time.monotonic(), self.env_steps

    def _evaluate(self) -> dict[str, float]:
        with self.stats.time("evaluate"):
            found = evaluate_recipe(
                self.recipe, self.learner, should_stop=lambda: self._stop.requested
            ).metrics()
        _LOG.info(
            "%d of %d env steps, return %.1f +- %.1f over %d episodes, %.0f s",
            self.env_steps,
            self.recipe.total_env_steps,
            found["eval/return"],
            found["eval/return_std"],
            found["eval/episodes"],
            self.wall_s,
        )
        return found

    def _not_finite(self, what: str) -> RunError:
        algo, steps = self.recipe.algo, self.env_steps
        return RunError(
            f"{self.run_dir}: not finite after {steps} env steps and "
            f"{self.learner.updates} updates: {what}. No checkpoint was written over; "
            f"the newest good one is {newest_checkpoint(self.run_dir)}. Go on from it "
            f"with a smaller learning rate, say: flashdex train --resume "
            f"{self.run_dir} algo.lr={algo.lr / 2:g} "
            f"algo.lr_final={algo.lr_final / 2:g}"
        )

    def _try_to_save(self) -> None:
        """Save; a disk that is full may have room again at the next time."""
        try:
            self.save()
        except OSError as error:
            _LOG.warning("no checkpoint this time, the run goes on: %s", error)

    def save(self) -> None:
        """Write a checkpoint and the new replay rows, unless there is one of this step.

        Raises:
            NonFiniteError: what would be stored is not finite.
            OSError: it cannot be written.
        """
        if self.env_steps == self._saved_at:
            return
        state = self.state_dict()
        if bad := first_non_finite(state["learner"]):
            raise NonFiniteError(bad)
        keep = self.recipe.train.keep_checkpoints
        save_checkpoint(self.run_dir, state, keep=keep, replay=self.replay)
        self._saved_at = self.env_steps

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs but the rows, tensors and plain values."""
        return {
            "env_steps": self.env_steps,
            "wall_s": self.wall_s,
            "learner": self.learner.state_dict(),
            "wandb_id": self.log.wandb_id,
        }
