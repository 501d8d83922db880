"""Recipes: schema (the one place of defaults), compose, validate, dump."""

from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import EnvConfig, GymConfig
from flashdex.envs.mdp.assist import AssistConfig
from flashdex.envs.mdp.resets import ResetNoise
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.metrics.criteria_table import CRITERIA, CriterionName
from flashdex.recipe.check import validate
from flashdex.recipe.compose import (
    compose,
    compose_runs,
    dump_recipe,
    inspect_recipe,
    load_recipe,
    override_recipe,
)
from flashdex.recipe.motions import MotionsConfig
from flashdex.recipe.run import LoggerConfig, LoopConfig, TrainConfig
from flashdex.recipe.schema import Expectation, Recipe, RunRecipe
from flashdex.recipe.store import copy_recipe, find_recipe, list_recipes
from flashdex.recipe.tasks import GymRecipe, expect_kind, require_motions, task_of_run

__all__ = [
    "CRITERIA",
    "AlgoConfig",
    "AssistConfig",
    "CriterionName",
    "EnvConfig",
    "Expectation",
    "GymConfig",
    "GymRecipe",
    "LoggerConfig",
    "LoopConfig",
    "MotionsConfig",
    "PhysicsConfig",
    "Recipe",
    "ResetNoise",
    "RunRecipe",
    "TrainConfig",
    "compose",
    "compose_runs",
    "copy_recipe",
    "dump_recipe",
    "expect_kind",
    "find_recipe",
    "inspect_recipe",
    "list_recipes",
    "load_recipe",
    "override_recipe",
    "require_motions",
    "task_of_run",
    "validate",
]
