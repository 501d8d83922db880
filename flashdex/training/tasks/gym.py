"""Stock environments as a task: returns of episodes, and evaluations in between."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from flashdex import keys
from flashdex.algorithms import find_algorithm
from flashdex.algorithms.base import Learner, TaskSpec
from flashdex.envs.gym import GymEnv
from flashdex.errors import FlashdexError
from flashdex.recipe import GymRecipe, RunRecipe, expect_kind
from flashdex.training.session import SIGNAL, SessionStart
from flashdex.training.tasks.base import Task

if TYPE_CHECKING:
    from flashdex.training.trainer import Trainer

_LOG = logging.getLogger(__name__)
# Keeps the starts of evaluations apart from those of training. A resumed run begins at
# its seed plus its env steps, so the offset is one that no budget reaches.
SEED_OFFSET = 2**30


class GymTask(Task):
    """Returns and evaluations of a stock environment."""

    worlds_key = "gym.num_envs"
    # checkpoints of earlier versions hold no more
    evaluated_keys = ("env_steps", "learner")
    resumed_keys = (*evaluated_keys, "wall_s", "wandb_id")
    state_keys = (keys.OBSERVATION,)
    updates_during_step = False

    def __init__(self, recipe: GymRecipe) -> None:
        self.recipe, self._note = recipe, "no evaluation yet"
        self.record_due = False  # an evaluation is

    @classmethod
    def open(cls, recipe: RunRecipe, run_dir: Path | None = None) -> GymTask:
        """Refuse an environment that cannot be used.

        Raises:
            FlashdexError: it cannot, or the recipe asks for a GPU.
        """
        recipe = expect_kind(recipe, GymRecipe, where=str(run_dir))
        if recipe.algo.device == "cuda":
            raise FlashdexError(
                "algo.device: a gym recipe learns on the CPU, beside its environments. "
                "Use algo.device=cpu or auto."
            )
        task = cls(recipe)
        task.make_env(num_envs=1).close()
        return task

    def make_env(self, *, num_envs: int | None = None) -> GymEnv:
        """See ``Task``."""
        gym = self.recipe.gym
        return GymEnv(gym, num_envs=num_envs or gym.num_envs, seed=self.recipe.seed)

    def make_learner(self, env: GymEnv) -> Learner:
        """See ``Task``."""
        recipe = self.recipe
        spec = TaskSpec(
            example=env.reset(),
            action_dim=env.action_dim,
            vector_steps=recipe.schedule_env_steps / env.num_envs,
            seed=recipe.seed,
            device=torch.device("cpu"),
        )
        return find_algorithm(recipe.algo.kind)(recipe.algo, spec)

    @property
    def rows_meaning(self) -> str:
        """What replay rows depend on."""
        gym, algo = self.recipe.gym, self.recipe.algo
        what = [gym.env_id, gym.max_episode_steps, gym.rescale_actions]
        return str([*what, algo.n_step, algo.gamma])

    def prepare(self, run_dir: Path, env: GymEnv) -> None:
        """Take the worlds."""
        self.env = env
        self._returns = torch.zeros(env.num_envs, 1, dtype=torch.float64)
        self._lengths = torch.zeros(env.num_envs, 1, dtype=torch.int64)

    def begin(self, start: SessionStart, state: dict[str, Any] | None) -> None:
        """A resumed run goes on from fresh starts, not from those it began with."""
        self.env.seed = self.recipe.seed + start.env_steps
        self._evaluated_at = start.env_steps

    def after_step(self, trainer: Trainer, after: TensorDictBase) -> None:
        """Count returns, those not finite as 0, and see whether to evaluate."""
        reward, done = after[keys.REWARD], after[keys.DONE]
        self._returns += torch.where(reward.isfinite(), reward, 0.0)
        self._lengths += 1
        stats = trainer.stats
        stats.add_ends(done, after[keys.TERMINATED])
        if done.any():
            ended = {"episode/return": self._returns, "episode/length": self._lengths}
            sums = [value[done].double().sum() for value in ended.values()]
            stats.add(list(ended), torch.stack(sums), done.sum())
            for value in ended.values():
                value[done] = 0
        every, steps = self.recipe.gym.eval_every_env_steps, trainer.env_steps
        before = steps - self.env.num_envs
        is_last = steps >= self.recipe.total_env_steps
        self.record_due = is_last or steps // every > before // every

    def rewards(self, after: TensorDictBase) -> Tensor:
        """Rewards, (N, 1)."""
        return after[keys.REWARD]

    def finish(self, trainer: Trainer, why: str) -> None:
        """Ask for a closing evaluation, unless somebody wants the run to end."""
        self.record_due = why != SIGNAL and trainer.env_steps > self._evaluated_at

    @property
    def note(self) -> str:
        """Return of the newest evaluation."""
        return self._note

    @property
    def num_results(self) -> int:
        """Env steps of the newest evaluation."""
        return self._evaluated_at

    def metrics(self, trainer: Trainer) -> dict[str, float]:
        """Scale of the rewards and, where it is due, an evaluation."""
        record = trainer.learner.metrics()
        if self.record_due:
            self.record_due, self._evaluated_at = False, trainer.env_steps
            with suppress(StoppedError):  # the record goes without it
                record |= self._evaluate(trainer)
        return record

    def _evaluate(self, trainer: Trainer) -> dict[str, float]:
        with trainer.stats.time("evaluate"):
            found = self._play(trainer.learner, lambda: trainer.stop.requested)
        metrics = found.metrics()
        self._note = f"return {metrics['eval/return']:.1f}"
        _LOG.info(
            "%d of %d env steps, return %.1f +- %.1f over %d episodes, %.0f s",
            trainer.env_steps,
            self.recipe.total_env_steps,
            metrics["eval/return"],
            metrics["eval/return_std"],
            metrics["eval/episodes"],
            trainer.wall_s,
        )
        return metrics

    def _play(
        self, learner: Learner, should_stop: Callable[[], bool] = lambda: False
    ) -> GymEvaluation:
        """Play the evaluation episodes: the same starts at every call."""
        count, seed = self.recipe.gym.eval_episodes, self.recipe.seed + SEED_OFFSET
        env = GymEnv(self.recipe.gym, num_envs=count, seed=seed)
        try:
            return evaluate_policy(learner, env, should_stop=should_stop)
        finally:
            env.close()

    def evaluate(self, learner: Learner, env_steps: int) -> dict[str, Any]:
        """Play the evaluation episodes of the recipe.

        Returns:
            Env steps, metrics and the return of each episode.
        """
        found = self._play(learner)
        return {
            "env_id": self.recipe.gym.env_id,
            "env_steps": env_steps,
            **found.metrics(),
            "returns": [round(value, 3) for value in found.returns.tolist()],
        }

    def close(self, *, wait: bool) -> None:
        """Free the worlds."""
        self.env.close()


class StoppedError(Exception):
    """An evaluation was told to end before its episodes did."""


@dataclass(frozen=True)
class GymEvaluation:
    """One episode of each world."""

    returns: Tensor  # undiscounted sums of raw rewards, (E,); not finite ones are 0
    lengths: Tensor  # steps, (E,)

    def metrics(self) -> dict[str, float]:
        """What is logged of an evaluation."""
        return {
            "eval/return": self.returns.mean().item(),
            "eval/return_std": self.returns.std(correction=0).item(),
            "eval/return_min": self.returns.min().item(),
            "eval/return_max": self.returns.max().item(),
            "eval/length": self.lengths.float().mean().item(),
            "eval/episodes": float(len(self.returns)),
        }


def evaluate_policy(
    learner: Learner,
    env: GymEnv,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> GymEvaluation:
    """Play one episode in each world from its seed, without exploration.

    Neither noise nor statistics of the learner move.

    Raises:
        StoppedError: ``should_stop`` said so; it is asked before every vector step.
    """
    returns = torch.zeros(env.num_envs, 1, dtype=torch.float64)
    lengths = torch.zeros(env.num_envs, 1, dtype=torch.int64)
    alive = torch.ones(env.num_envs, 1, dtype=torch.bool)
    bad = 0
    td = env.reset()
    while alive.any():
        if should_stop():
            raise StoppedError
        env.put_action(td, learner.act(td, explore=False))
        td = env.step(td)
        reward, done = td["next", keys.REWARD], td["next", keys.DONE]
        finite = reward.isfinite()
        bad += int((alive & ~finite).sum())
        returns += torch.where(alive & finite, reward, 0.0)
        lengths += alive
        alive &= ~done
        # worlds step together; a second episode does not count
        td = env.reset_worlds(done.squeeze(-1)) if done.any() else step_mdp(td)
    if bad:
        _LOG.warning("%d rewards of the evaluation were not finite: taken as 0", bad)
    return GymEvaluation(returns.squeeze(-1), lengths.squeeze(-1))
