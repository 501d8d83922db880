"""Recorded hand-object motions to robot-hand trajectories that hold up in physics.

What stands here is the public interface; everything else may move. Heavy packages are
imported when a function is called.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, get_args

if TYPE_CHECKING:
    from torchrl.envs import TransformedEnv

    from flashdex.motions.library import MotionLibrary
    from flashdex.recipe import Recipe, RunRecipe
    from flashdex.training.loaded import Run, RunPolicy

__version__ = "0.1.0"
__all__ = ["compose", "load_library", "load_policy", "load_run", "make_env"]


def compose(name: str | Path, overrides: Sequence[str] = ()) -> RunRecipe:
    """Read a recipe, apply overrides as on the command line, and check it.

    Args:
        name: of a recipe (`flashdex ls`), or the path of a YAML file.
        overrides: ``key=value``, ``~key`` or ``group=option``.

    Raises:
        RecipeError: everything wrong with it, at once.

    Example:
        >>> import flashdex
        >>> flashdex.compose("quickstart", ["env.num_envs=4"]).env.num_envs
        4
    """
    _load_mujoco()
    _expect(name, str | Path, "compose: name")
    _expect(overrides, list | tuple, "compose: overrides")
    for i, word in enumerate(overrides):
        _expect(word, str, f"compose: overrides[{i}]")
    from flashdex.recipe import compose

    return compose(name, list(overrides))


def _expect(value: object, kind: type | UnionType, where: str) -> None:
    if not isinstance(value, kind):
        from flashdex.errors import FlashdexError

        kinds = get_args(kind) or (kind,)
        wanted = " or ".join(getattr(k, "__name__", str(k)) for k in kinds)
        found = f"{value!r:.60} of type {type(value).__name__}"
        raise FlashdexError(f"{where}: expected {wanted}, found {found}")


def _load_mujoco() -> None:
    """Its import starts a Python process, glfw's: not from the folder we are in."""
    from flashdex.system.children import safe_path

    with safe_path():
        import mujoco  # noqa: F401


def _tracking_recipe(recipe: RunRecipe | str | Path, *, where: str) -> Recipe:
    from flashdex.recipe import Recipe, RunRecipe, expect_kind, validate

    _expect(recipe, RunRecipe | str | Path, where)
    if isinstance(recipe, str | Path):
        recipe = compose(recipe)
    # one that was changed in Python was not checked since
    return validate(expect_kind(recipe, Recipe, where=where))


def make_env(
    recipe: RunRecipe | str | Path,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    evaluation: bool = False,
) -> TransformedEnv:
    """The tracking environment of a recipe with its observation transforms.

    Actions are ``("left", "action")`` and ``("right", "action")``, (N, J) in [-1, 1];
    rewards ``(side, "reward")``, (N, 1); the transforms add ``observation``, (N, D),
    ``future``, (N, C, K), and ``group_mask``, (N, 2). Motions are prepared where the
    recipe names a source and no library.

    Args:
        recipe: a recipe, or the name or path of one.
        num_envs: worlds N; the recipe's number when None.
        seed: of resets; the recipe's when None.
        evaluation: no terminations, noise or assist; every episode begins at frame 0.

    Raises:
        FlashdexError: the recipe has mistakes, or its motions cannot be had.
    """
    _load_mujoco()
    from torchrl.envs import TransformedEnv

    from flashdex.envs.config import EnvConfig
    from flashdex.recipe.check import check_option, validate
    from flashdex.training.build import RunBuilder

    found = _tracking_recipe(recipe, where="make_env")
    if seed is not None:
        found = validate(replace(found, seed=seed))
    if num_envs is not None:
        check_option(EnvConfig, "num_envs", num_envs, where="make_env")
    _expect(evaluation, bool, "make_env: evaluation")
    builder = RunBuilder.from_recipe(found)
    plain = builder.make_env(num_envs=num_envs, evaluation=evaluation)
    env = TransformedEnv(plain)
    for transform in builder.make_transforms(builder.bank):
        env.append_transform(transform)
    return env


def load_library(source: RunRecipe | str | Path) -> MotionLibrary:
    """Open a motion library.

    Args:
        source: folder of a prepared library, or a recipe, whose motions are prepared
            where they are not yet and selected as it says.

    Raises:
        LibraryError: it is missing, incomplete or of another schema.
    """
    _load_mujoco()
    if isinstance(source, str | Path):
        from flashdex.motions.library import MotionLibrary

        return MotionLibrary.load(source)
    from flashdex.training.build import load_library, select_motions

    recipe = _tracking_recipe(source, where="load_library")
    return select_motions(load_library(recipe), recipe)


def load_run(run_dir: str | Path) -> Run:
    """Open a run for reading: recipe, attempts, metrics, rollouts, policy.

    Raises:
        RunError: the folder holds no run.
    """
    _load_mujoco()
    _expect(run_dir, str | Path, "load_run")
    from flashdex.training.loaded import Run

    run = Run(Path(run_dir))
    _ = run.recipe  # says at once whether there is one
    return run


def load_policy(run: Run | str | Path) -> RunPolicy:
    """The newest policy of a run as a TensorDict module.

    It reads the compact state, which every environment of `make_env` emits, and writes
    the actions of both hands.

    Args:
        run: from `load_run`, or its folder.

    Raises:
        RunError: there is no run, or no checkpoint that can be read.
    """
    from flashdex.training.loaded import Run

    opened = run if isinstance(run, Run) else load_run(run)
    return opened.policy()
