"""Schema of a recipe for a stock Gymnasium environment (``task: gym``)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import GymConfig
from flashdex.recipe.algo import LoopConfig
from flashdex.recipe.relations import expect_conflicts, rate_conflicts, replay_conflicts
from flashdex.recipe.schema import RunRecipe

# Keys of `algo` that speak of hands or of the future window.
HAND_ONLY = (
    "groups",
    "critic_action",
    "own_action_gate",
    "future_latent",
    "future_channels",
    "ppo",
)


@dataclass(frozen=True, kw_only=True)
class GymRecipe(RunRecipe):
    """One training run on a stock environment, complete.

    Example:
        >>> GymRecipe(name="tiny", total_env_steps=1000).gym.num_envs
        1
    """

    task: Literal["gym"] = "gym"
    """What is trained: a stock environment; must be given."""
    gym: GymConfig = dataclasses.field(default_factory=GymConfig)
    """Environment."""
    algo: AlgoConfig = dataclasses.field(default_factory=AlgoConfig)
    """Learner."""
    train: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    """Loop."""

    @property
    def tags(self) -> list[str]:
        """Words that tell this run from others."""
        return [self.gym.env_id]

    @property
    def schedule_env_steps(self) -> int:
        """Env steps that the learning rate is laid out for."""
        return self.gym.schedule_env_steps or self.total_env_steps


def find_gym_conflicts(recipe: GymRecipe) -> list[str]:
    """Return one line for each thing that does not fit together."""
    return [
        *_environment(recipe),
        *_hand_keys(recipe.algo),
        *replay_conflicts(
            recipe.algo,
            total_env_steps=recipe.total_env_steps,
            num_envs=recipe.gym.num_envs,
            where="gym.num_envs",
        ),
        *rate_conflicts(recipe.algo),
        *expect_conflicts(recipe.expect),
    ]


def _environment(recipe: GymRecipe) -> list[str]:
    gym = recipe.gym
    problems = []
    if not gym.env_id:
        problems.append("gym.env_id: missing; every recipe with task: gym must give it")
    if ":" in gym.env_id:
        problems.append(
            f"gym.env_id: '{gym.env_id}' names a module to import; recipes name "
            "registered environments only"
        )
    if recipe.schedule_env_steps < recipe.total_env_steps:
        problems.append(
            f"gym.schedule_env_steps: {gym.schedule_env_steps} ends before "
            f"total_env_steps={recipe.total_env_steps}"
        )
    return problems


def _hand_keys(algo: AlgoConfig) -> list[str]:
    plain = AlgoConfig()
    problems = []
    if algo.kind != "flashsac":
        problems.append(
            f"algo.kind: '{algo.kind}' is not available with task: gym; use flashsac"
        )
    return problems + [
        f"algo.{key}: has no effect with task: gym, which has neither hands nor a "
        "future window; leave it out"
        for key in HAND_ONLY
        if getattr(algo, key) != getattr(plain, key)
    ]
