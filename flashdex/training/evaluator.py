"""Full-length rollouts of every motion under a given controller."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.envs.gym import GymWorlds
from flashdex.envs.tracking import TrackingEnv
from flashdex.recipe import GymRecipe
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.rollouts.rollout import Rollout
from flashdex.training.build import Workbench

Controller = Callable[[TensorDictBase, TrackingEnv], Tensor]
"""State and environment to actions (N, 2, J)."""


def roll_all(
    bench: Workbench,
    controller: Controller,
    *,
    env_steps: int = 0,
    worlds: int = 32,
    target: Callable[[TrackingEnv], Tensor] | None = None,
) -> list[Rollout]:
    """Roll every motion once from frame 0, without assist, noise or terminations.

    Args:
        bench: motions and recipe.
        controller: what acts.
        env_steps: counter stored with the rollouts.
        worlds: motions rolled side by side.
        target: joint position targets (N, 2, J) that replace those of the action, for
            controllers outside the action space.

    Returns:
        One rollout a motion, in library order.
    """
    total = bench.bank.num_motions
    out: list[Rollout] = []
    for first in range(0, total, worlds):
        rows = torch.arange(first, min(first + worlds, total))
        out += _roll(bench, controller, rows, env_steps, target)
    return out


@torch.no_grad()
def _roll(
    bench: Workbench,
    controller: Controller,
    rows: Tensor,
    env_steps: int,
    target: Callable[[TrackingEnv], Tensor] | None,
) -> list[Rollout]:
    env = bench.make_env(num_envs=len(rows), evaluation=True)
    env.forced_motion = rows.to(env.device)
    env.target_override = target
    recorder = EpisodeRecorder(env, look_every=1)
    builder = bench.rollout_builder(env.physics.scenes)
    td = env.reset()
    recorder.record_start()
    found: dict[int, Rollout] = {}
    while len(found) < len(rows):
        action = controller(td, env)
        env.put_action(td, action)
        done = env.step(td)["next", keys.DONE]
        for episode in recorder.record_step(action, done, env_steps):
            if episode.motion not in found:  # short motions begin again
                found[episode.motion] = builder.build(episode)
        td = env.reset_worlds(done.squeeze(-1))
        recorder.record_start()
    return [found[r] for r in rows.tolist()]


_LOG = logging.getLogger(__name__)
# Keeps the starts of evaluations apart from those of training. A resumed run begins at
# its seed plus its env steps, so the offset is one that no budget reaches.
SEED_OFFSET = 2**30


class StoppedError(Exception):
    """An evaluation was told to end before its episodes did."""


@dataclass(frozen=True)
class GymEvaluation:
    """One episode of each world.

    Attributes:
        returns: undiscounted sums of raw rewards, (E,); those not finite count as 0.
        lengths: steps, (E,).
    """

    returns: Tensor
    lengths: Tensor

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


def observed(observation: Tensor) -> TensorDict:
    """The state a learner reads: a TensorDict (N,) with the observation (N, D)."""
    return TensorDict({keys.OBSERVATION: observation}, [len(observation)])


def evaluate_recipe(
    recipe: GymRecipe,
    learner: Learner,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> GymEvaluation:
    """Play the evaluation episodes of a recipe: the same starts at every call.

    Args:
        recipe: names the environment and the number of episodes.
        learner: acts; neither its noise nor its statistics move.
        should_stop: asked before every vector step.

    Raises:
        StoppedError: ``should_stop`` said so.
    """
    config = recipe.gym
    worlds = GymWorlds(
        config, num_envs=config.eval_episodes, seed=recipe.seed + SEED_OFFSET
    )
    try:
        return evaluate_policy(learner, worlds, should_stop=should_stop)
    finally:
        worlds.close()


def evaluate_policy(
    learner: Learner,
    worlds: GymWorlds,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> GymEvaluation:
    """Play one episode in each world from its seed, without exploration.

    Args:
        learner: acts; neither its noise nor its statistics move.
        worlds: one an episode, of a limited length.
        should_stop: asked before every vector step.

    Raises:
        StoppedError: ``should_stop`` said so.
    """
    returns = torch.zeros(worlds.num_envs, 1, dtype=torch.float64)
    lengths = torch.zeros(worlds.num_envs, 1, dtype=torch.int64)
    alive = torch.ones(worlds.num_envs, 1, dtype=torch.bool)
    bad = 0
    observation = worlds.reset()
    while alive.any():
        if should_stop():
            raise StoppedError
        step = worlds.step(learner.act(observed(observation), explore=False))
        finite = step.reward.isfinite()
        bad += int((alive & ~finite).sum())
        returns += torch.where(alive & finite, step.reward, 0.0)
        lengths += alive
        alive &= ~step.done
        observation = step.observation
        if step.done.any():  # worlds step together; a second episode does not count
            observation = worlds.reset_done(step.done)
    if bad:
        _LOG.warning("%d rewards of the evaluation were not finite: taken as 0", bad)
    return GymEvaluation(returns.squeeze(-1), lengths.squeeze(-1))
