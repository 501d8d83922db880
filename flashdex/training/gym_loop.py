"""The loop on a stock environment: act, step, remember, learn, evaluate, log."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from torch import Tensor

from flashdex.errors import RunError
from flashdex.recipe import GymRecipe
from flashdex.training.checkpoint import save_checkpoint
from flashdex.training.guard import GradientGuard, NonFiniteError
from flashdex.training.gym import GymWorlds
from flashdex.training.gym_evaluate import evaluate_recipe, observed
from flashdex.training.gym_learner import GymLearner
from flashdex.training.gym_stats import GymStats
from flashdex.training.logging import MetricLog
from flashdex.training.replay_file import ReplayLog
from flashdex.training.sessions import Start
from flashdex.training.signals import StopSignals

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
        self._began = time.monotonic()
        self._stop = StopSignals()

    @property
    def wall_s(self) -> float:
        """Seconds of this run, earlier sessions included."""
        return self.start.wall_s + time.monotonic() - self._began

    def run(self) -> str:
        """Train until the budget, a limit or a signal ends it; return why.

        Raises:
            RunError: a gradient was not finite, or the folder cannot be written.
        """
        recipe, config = self.recipe, self.recipe.gym
        # A resumed run goes on from fresh starts, not from those it began with.
        worlds = GymWorlds(
            config, num_envs=config.num_envs, seed=recipe.seed + self.env_steps
        )
        try:
            with self._stop, GradientGuard():
                why = self._loop(worlds)
                self.save()
        except NonFiniteError as error:
            raise RunError(
                f"{self.run_dir}: stopped at {self.env_steps} env steps, not finite: "
                f"{error}. The checkpoints are from before."
            ) from error
        except OSError as error:
            raise RunError(
                f"{self.run_dir}: cannot be written ({error}). Make room, then "
                f"continue it with 'flashdex train --resume {self.run_dir}'."
            ) from error
        finally:
            worlds.close()
        return why

    def _loop(self, worlds: GymWorlds) -> str:
        recipe = self.recipe
        observation = worlds.reset()
        last_log = last_save = time.monotonic()
        why = ""
        while not why:
            observation = self.vector_step(worlds, observation)
            why = self._end_reason()
            due = self._evaluation_due() or why == "budget"
            now = time.monotonic()
            if due or why or now - last_log >= recipe.train.log_every_s:
                self._write_log(now - last_log, evaluate=due)
                last_log = time.monotonic()
            if now - last_save >= recipe.train.checkpoint_every_s:
                self.save()
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
            with self.stats.time("update"):
                self.stats.add_update(self.learner.update())
        return worlds.reset_done(step.done) if step.done.any() else step.observation

    def _evaluation_due(self) -> bool:
        config = self.recipe.gym
        before = self.env_steps - config.num_envs
        every = config.eval_every_env_steps
        return self.env_steps // every > before // every

    def _end_reason(self) -> str:
        limit = self.recipe.train.wall_limit_s
        if self._stop.requested:
            return "signal"
        if limit is not None and self.wall_s > limit:
            return "wall_limit_s"
        return "budget" if self.env_steps >= self.recipe.total_env_steps else ""

    def _write_log(self, seconds: float, *, evaluate: bool) -> None:
        record: dict[str, Any] = {
            "env_steps": self.env_steps,
            "hours": self.wall_s / 3600,
            "updates": self.learner.updates,
            **self.stats.pop(max(seconds, 1e-9), self.recipe.gym.num_envs),
            "buffer/rows": self.learner.num_rows,
            "reward/scale": self.learner.agent.normalizer.denominator().item(),
        }
        if evaluate:
            with self.stats.time("evaluate"):
                found = evaluate_recipe(self.recipe, self.learner).metrics()
            record |= found
            _LOG.info(
                "%d of %d env steps, return %.1f +- %.1f over %d episodes, %.0f s",
                self.env_steps,
                self.recipe.total_env_steps,
                found["eval/return"],
                found["eval/return_std"],
                found["eval/episodes"],
                self.wall_s,
            )
        self.log.write(record)

    def save(self) -> Path:
        """Write a checkpoint, and beside it the new rows of the replay buffer."""
        keep = self.recipe.train.keep_checkpoints
        return save_checkpoint(
            self.run_dir, self.state_dict(), keep=keep, replay=self.replay
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs but the rows, tensors and plain values."""
        return {
            "env_steps": self.env_steps,
            "wall_s": self.wall_s,
            "learner": self.learner.state_dict(),
            "wandb_id": self.log.wandb_id,
        }
