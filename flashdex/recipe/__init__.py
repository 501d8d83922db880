"""Recipes: schema (the one place of defaults), compose, validate, dump.

What is named here is imported when it is used: listing recipes needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flashdex.recipe.check import validate as validate
    from flashdex.recipe.merge import compose as compose
    from flashdex.recipe.merge import compose_runs as compose_runs
    from flashdex.recipe.merge import dump_recipe as dump_recipe
    from flashdex.recipe.merge import load_recipe as load_recipe
    from flashdex.recipe.merge import override_recipe as override_recipe
    from flashdex.recipe.merge import parse_recipe as parse_recipe
    from flashdex.recipe.motions import MotionsConfig as MotionsConfig
    from flashdex.recipe.run import LoggerConfig as LoggerConfig
    from flashdex.recipe.run import LoopConfig as LoopConfig
    from flashdex.recipe.run import TrainConfig as TrainConfig
    from flashdex.recipe.schema import Recipe as Recipe
    from flashdex.recipe.schema import RunRecipe as RunRecipe
    from flashdex.recipe.store import copy_recipe as copy_recipe
    from flashdex.recipe.store import require_motions as require_motions
    from flashdex.recipe.store import task_of_run as task_of_run
    from flashdex.recipe.tasks import GymRecipe as GymRecipe
    from flashdex.recipe.tasks import SearchRecipe as SearchRecipe
    from flashdex.recipe.tasks import expect_kind as expect_kind

_PARTS = ("reader", "store", "run", "motions", "schema", "tasks", "check", "merge")


def __getattr__(name: str) -> Any:
    for part in _PARTS if not name.startswith("_") and name not in _PARTS else ():
        module = import_module(f"{__name__}.{part}")
        if hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
