"""Returns of the deterministic policy on a stock environment."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.recipe import GymRecipe
from flashdex.training.gym import GymWorlds
from flashdex.training.learner import Learner

# Keeps the starts of evaluations apart from those of training.
SEED_OFFSET = 1_000_000


@dataclass(frozen=True)
class GymEvaluation:
    """One episode of each world.

    Attributes:
        returns: undiscounted sums of raw rewards, (E,).
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


def evaluate_recipe(recipe: GymRecipe, learner: Learner) -> GymEvaluation:
    """Play the evaluation episodes of a recipe: the same starts at every call.

    Args:
        recipe: names the environment and the number of episodes.
        learner: acts; neither its noise nor its statistics move.
    """
    config = recipe.gym
    worlds = GymWorlds(
        config, num_envs=config.eval_episodes, seed=recipe.seed + SEED_OFFSET
    )
    try:
        return evaluate_policy(learner, worlds)
    finally:
        worlds.close()


def evaluate_policy(learner: Learner, worlds: GymWorlds) -> GymEvaluation:
    """Play one episode in each world from its seed, without exploration.

    Args:
        learner: acts; neither its noise nor its statistics move.
        worlds: one an episode, of a limited length.
    """
    returns = torch.zeros(worlds.num_envs, 1, dtype=torch.float64)
    lengths = torch.zeros(worlds.num_envs, 1, dtype=torch.int64)
    alive = torch.ones(worlds.num_envs, 1, dtype=torch.bool)
    observation = worlds.reset()
    while True:
        step = worlds.step(learner.act(observed(observation), explore=False))
        returns += step.reward * alive
        lengths += alive
        alive &= ~step.done
        if not alive.any():
            return GymEvaluation(returns.squeeze(-1), lengths.squeeze(-1))
        observation = step.observation
        if step.done.any():  # worlds step together; a second episode does not count
            observation = worlds.reset_done(step.done)
