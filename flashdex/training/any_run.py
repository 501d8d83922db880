"""Start and resume runs of every kind of recipe."""

from __future__ import annotations

from pathlib import Path

from flashdex.errors import RunError
from flashdex.recipe import (
    GymRecipe,
    Recipe,
    RunRecipe,
    expect_kind,
    load_recipe,
    task_of_run,
)


def train(recipe: RunRecipe) -> Path:
    """Train a recipe from the beginning; return its run directory.

    Args:
        recipe: validated recipe of any kind.
    """
    if isinstance(recipe, GymRecipe):
        from flashdex.training.gym_run import train_gym

        return train_gym(recipe)
    from flashdex.training.run_dir import train as train_retarget

    return train_retarget(expect_kind(recipe, Recipe, where="train"))


def stored_recipe(run_dir: Path, overrides: list[str]) -> RunRecipe:
    """Read the recipe that `resume` would go on with; nothing is started.

    Args:
        run_dir: run directory.
        overrides: ``key=value`` changes to the stored recipe.

    Raises:
        RunError: the folder holds no run.
    """
    path = run_dir / "recipe.yaml"
    if not path.is_file():
        raise RunError(f"{run_dir}: not a run directory, there is no {path.name} in it")
    return load_recipe(path, overrides)


def resume(run_dir: Path, overrides: list[str]) -> Path:
    """Continue a run of any kind from its newest checkpoint.

    Args:
        run_dir: run directory.
        overrides: ``key=value`` changes to the stored recipe.
    """
    if task_of_run(run_dir) == "gym":
        from flashdex.training.gym_run import resume_gym

        return resume_gym(run_dir, overrides)
    from flashdex.training.run_dir import resume as resume_retarget

    return resume_retarget(run_dir, overrides)
