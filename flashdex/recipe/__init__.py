"""Recipes: schema (the one place of defaults), compose, validate, dump."""

from flashdex.recipe.algo import (
    CRITERIA,
    AlgoConfig,
    Criterion,
    LoggerConfig,
    TrainConfig,
)
from flashdex.recipe.check import validate
from flashdex.recipe.compose import (
    compose,
    compose_runs,
    dump_recipe,
    inspect_recipe,
    load_recipe,
    override_recipe,
)
from flashdex.recipe.env import (
    AssistConfig,
    EnvConfig,
    MotionsConfig,
    PhysicsConfig,
    ResetNoise,
)
from flashdex.recipe.options import (
    REWARDS,
    TERMINATIONS,
    TRANSFORMS,
    build_options,
)
from flashdex.recipe.schema import Expectation, Recipe
from flashdex.recipe.store import copy_recipe, find_recipe, list_recipes

__all__ = [
    "CRITERIA",
    "REWARDS",
    "TERMINATIONS",
    "TRANSFORMS",
    "AlgoConfig",
    "AssistConfig",
    "Criterion",
    "EnvConfig",
    "Expectation",
    "LoggerConfig",
    "MotionsConfig",
    "PhysicsConfig",
    "Recipe",
    "ResetNoise",
    "TrainConfig",
    "build_options",
    "compose",
    "compose_runs",
    "copy_recipe",
    "dump_recipe",
    "find_recipe",
    "inspect_recipe",
    "list_recipes",
    "load_recipe",
    "override_recipe",
    "validate",
]
