"""The training loop: act, step, remember, learn, judge attempts, log."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from flashdex import keys
from flashdex.envs.judge import Outcome
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import RunError
from flashdex.recipe import Recipe
from flashdex.training.assist_epoch import AssistEpoch
from flashdex.training.attempts import AttemptRecorder
from flashdex.training.checkpoint import save_checkpoint
from flashdex.training.learner import Learner
from flashdex.training.ledger import Ledger
from flashdex.training.logging import MetricLog
from flashdex.training.stats import RunningStats

_LOG = logging.getLogger(__name__)
PLAIN_LOG_S = 30.0  # s between progress lines where there is no terminal


class Trainer:
    """Owns the counters of a run and performs vector steps.

    Args:
        recipe: validated recipe.
        run_dir: run directory.
        env: tracking environment.
        learner: acts and learns.
        ledger: judges attempts.
        log: metric writers.
        provenance: stored with every rollout.
    """

    def __init__(
        self,
        recipe: Recipe,
        run_dir: Path,
        env: TrackingEnv,
        learner: Learner,
        ledger: Ledger,
        log: MetricLog,
        provenance: dict[str, str] | None = None,
    ) -> None:
        self.recipe, self.run_dir, self.env = recipe, run_dir, env
        self.learner, self.ledger, self.log = learner, ledger, log
        self.recorder = AttemptRecorder(
            env,
            criterion=recipe.train.criterion,
            seed=recipe.seed,
            provenance=provenance,
        )
        self.stats = RunningStats()
        self.assist_epoch = AssistEpoch()
        self.env_steps = 0
        self.wall_before = 0.0
        self._vector_steps = 0
        self._start = time.monotonic()
        self._last_line = self._start
        self._stop = False

    @property
    def wall_s(self) -> float:
        """Seconds of this run, earlier sessions included."""
        return self.wall_before + time.monotonic() - self._start

    def run(self) -> str:
        """Train until the budget, a limit or a signal ends it; return why."""
        recipe, train = self.recipe, self.recipe.train
        for name in self.ledger.conversions:
            self._mark_converted(name)
        td = self.env.reset()
        self.recorder.begin(torch.arange(self.env.num_envs))
        last_log = last_save = time.monotonic()
        why = "budget"
        with self._signals(), self._bar() as bar:
            while self.env_steps < recipe.total_env_steps:
                td = self.vector_step(td)
                bar.update(self.env.num_envs)
                now = time.monotonic()
                if now - last_log >= train.log_every_s:
                    self._write_log(now - last_log)
                    self._show(bar)
                    last_log = now
                if now - last_save >= train.checkpoint_every_s:
                    self.save()
                    last_save = now
                why = self._end_reason()
                if why:
                    break
            else:
                why = "budget"
        self._write_log(max(time.monotonic() - last_log, 1e-9))
        self.save()
        return why

    def vector_step(self, td: TensorDictBase) -> TensorDictBase:
        """One step of all worlds, with the updates that belong to it."""
        with self.stats.time("act"):
            action = self.learner.act(td)
            for i, side in enumerate(keys.SIDES):
                td.set(keys.action(side), action[:, i])
        with self.stats.time("env"):
            td = self.env.step(td)
        after = td.get("next")
        self.env_steps += self.env.num_envs
        self._vector_steps += 1
        self._judge(action, after)
        with self.stats.time("remember"):
            reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
            terminated, done = after[keys.TERMINATED], after[keys.DONE]
            self.learner.remember(td, action, reward, after, terminated, done)
        assert self.env.info is not None
        outcome = self.env.info.outcome
        self.stats.add_step(outcome, done, terminated)
        self._learn()
        self._assist_epoch(outcome, done, terminated)
        with self.stats.time("reset"):
            return self._advance(td, done)

    def _advance(self, td: TensorDictBase, done: Tensor) -> TensorDictBase:
        td = step_mdp(td)
        if done.any():
            ids = done.squeeze(-1).nonzero().squeeze(-1)
            td.set("_reset", done.clone())
            td = self.env.reset(td)
            self.recorder.begin(ids)
        return td

    def _judge(self, action: Tensor, after: TensorDictBase) -> None:
        for attempt in self.recorder.step(action, after, self.env_steps):
            converted = self.ledger.record(
                attempt, env_steps=self.env_steps, wall_s=self.wall_s
            )
            if converted is not None:
                self._mark_converted(converted.motion)

    def _mark_converted(self, name: str) -> None:
        row = self.env.bank.names.index(name)
        self.env.sampler.mark_converted(row)
        self.env.attempt_sampler.mark_converted(row)

    def _learn(self) -> None:
        for _ in range(self.learner.due()):
            with self.stats.time("update"):
                self.stats.add_update(self.learner.update())

    def _assist_epoch(self, outcome: Outcome, done: Tensor, terminated: Tensor) -> None:
        assist = self.env.assist
        if assist is None:
            return
        self.assist_epoch.add(outcome, ~self.env.attempt, done, terminated)
        if self._vector_steps % assist.config.epoch_steps == 0 and assist.end_epoch(
            **self.assist_epoch.pop()
        ):
            self.env.redraw_assist()

    def _end_reason(self) -> str:
        train = self.recipe.train
        if self._stop:
            return "signal"
        if train.wall_limit_s is not None and self.wall_s > train.wall_limit_s:
            return "wall_limit_s"
        everything = self.ledger.num_converted == len(self.ledger.names)
        if train.stop_when_all_converted and everything:
            return "all converted"
        return ""

    def _write_log(self, seconds: float) -> None:
        record: dict[str, Any] = {
            "env_steps": self.env_steps,
            "hours": self.wall_s / 3600,
            "updates": self.learner.updates,
        }
        record.update(self.ledger.metrics(self.wall_s / 3600))
        record.update(self.stats.pop(seconds, self.env.num_envs))
        record["buffer/rows"] = self.learner.num_rows
        assist = self.env.assist
        record["assist/level"] = assist.upper[0] if assist is not None else 0.0
        self.log.write(record)

    def _show(self, bar: tqdm) -> None:
        total = len(self.ledger.names)
        note = f"{self.ledger.num_converted}/{total} converted"
        if self.ledger.num_converted:
            note += f", {self.ledger.num_certified} certified"
        bar.set_postfix_str(note)
        now = time.monotonic()
        if bar.disable and now - self._last_line >= PLAIN_LOG_S:
            self._last_line = now
            _LOG.info(
                "%d of %d env steps, %s, %.0f s",
                self.env_steps,
                self.recipe.total_env_steps,
                note,
                self.wall_s,
            )

    def _bar(self) -> tqdm:
        # Without a terminal tqdm would fill the log with carriage returns.
        return tqdm(
            total=self.recipe.total_env_steps,
            initial=self.env_steps,
            unit="step",
            unit_scale=True,
            desc=self.recipe.name,
            disable=None,
            dynamic_ncols=True,
        )

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Turn Ctrl-C and SIGTERM into a clean end with a checkpoint."""

        def stop(*_: object) -> None:
            self._stop = True

        names = (signal.SIGINT, signal.SIGTERM)
        before = {n: signal.signal(n, stop) for n in names}
        try:
            yield
        finally:
            for name, handler in before.items():
                signal.signal(name, handler)

    def save(self) -> Path:
        """Write a checkpoint."""
        return save_checkpoint(
            self.run_dir, self.state_dict(), keep=self.recipe.train.keep_checkpoints
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs, tensors and plain values only."""
        assist = self.env.assist
        return {
            "env_steps": self.env_steps,
            "vector_steps": self._vector_steps,
            "wall_s": self.wall_s,
            "learner": self.learner.state_dict(),
            "assist": None if assist is None else assist.state_dict(),
            "env_generator": self.env.generator.get_state(),
            "torch_rng": torch.get_rng_state(),
            "wandb_id": self.log.wandb_id,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``; unfinished episodes begin anew."""
        self.env_steps = state["env_steps"]
        self._vector_steps = state["vector_steps"]
        self.wall_before = state["wall_s"]
        try:
            self.learner.load_state_dict(state["learner"])
        except RuntimeError as error:
            raise RunError(
                "the checkpoint does not fit the recipe: an override changed the "
                f"networks, the observation or env.num_envs ({error}). Resume without "
                "it, or start a new run."
            ) from error
        self.learner.forget_episodes()
        if self.env.assist is not None and state["assist"] is not None:
            self.env.assist.load_state_dict(state["assist"])
            self.env.redraw_assist()
        self.env.generator.set_state(state["env_generator"])
        torch.set_rng_state(state["torch_rng"])
