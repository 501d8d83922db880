"""The recipe: everything one training run is made of."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import EnvConfig
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.recipe.motions import MotionsConfig
from flashdex.recipe.run import LoggerConfig, TrainConfig
from flashdex.system.fields import SEED_MAX, number


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """A number the recipe promises, read by the job that trains it."""

    metric: str
    """Key of `metrics.jsonl`."""
    at_env_steps: int = number(dataclasses.MISSING, low=1, high=10**12)
    """Env steps at which it is read."""
    min: float | None = number(None, low=-1e15, high=1e15)
    """Smallest accepted value."""
    max: float | None = number(None, low=-1e15, high=1e15)
    """Largest accepted value."""


@dataclass(frozen=True, kw_only=True)
class RunRecipe:
    """What every kind of recipe has."""

    name: str
    """Name of the recipe; taken from the file name when absent."""
    total_env_steps: int = number(dataclasses.MISSING, low=1, high=10**12)
    """Budget, control steps summed over worlds."""
    ablation: str = "none"
    """Ablation files that were applied; set by composing, not by hand."""
    seed: int = number(0, low=0, high=SEED_MAX)
    """Seed of everything that is drawn."""
    run_dir: str | None = None
    """Folder of the run; null = runs/<name>-<ablation>-s<seed>."""
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    """Metric writers."""
    expect: list[Expectation] = dataclasses.field(default_factory=list)
    """Promised numbers."""

    @property
    def tags(self) -> list[str]:
        """Words that tell this run from others."""
        return []


@dataclass(frozen=True, kw_only=True)
class Recipe(RunRecipe):
    """One training run, complete.

    Example:
        >>> Recipe(name="tiny", total_env_steps=1000).env.num_envs
        2048
    """

    task: Literal["retarget"] = "retarget"
    """What is done: a policy is trained on motions; `search` looks for the actions of
    each motion alone, `gym` trains on a stock environment; those have keys of their
    own."""
    hand: str = "xhand"
    """Robot hand."""
    motions: MotionsConfig = dataclasses.field(default_factory=MotionsConfig)
    """Which motions."""
    physics: PhysicsConfig = dataclasses.field(default_factory=PhysicsConfig)
    """Which engine."""
    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    """Environment."""
    algo: AlgoConfig = dataclasses.field(default_factory=AlgoConfig)
    """Learner."""
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    """Loop."""

    @property
    def tags(self) -> list[str]:
        """Words that tell this run from others."""
        return [self.hand, self.physics.engine]
