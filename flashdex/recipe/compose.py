"""From a recipe's name and overrides to a checked recipe.

Hydra merges the files (defaults list, groups, ablations); values, defaults and names
are then checked here against the dataclasses, because Hydra would stop at the first
mistake.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from flashdex.errors import FlashdexError, RecipeError
from flashdex.recipe.check import read_recipe
from flashdex.recipe.defaults import check_defaults, known_groups
from flashdex.recipe.kinds import kind_of, mark_groups
from flashdex.recipe.overrides import (
    apply_values,
    choose_groups,
    expand_sweeps,
    hydra_choices,
    parse_overrides,
)
from flashdex.recipe.schema import RunRecipe
from flashdex.recipe.store import find_recipe, search_dirs


def compose(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> RunRecipe:
    """Compose a recipe; every mistake in it is reported at once.

    Args:
        name_or_path: a name that `flashdex ls` lists, or a YAML file.
        overrides: Hydra overrides: `seed=1`, `ablation=no_future`,
            `~env.transforms.contact`.

    Raises:
        RecipeError: with all problems, each with its YAML path.

    Example:
        >>> compose("quickstart", ["seed=8"]).seed
        8
    """
    recipe, problems = inspect_recipe(name_or_path, overrides)
    if problems:
        raise RecipeError(problems, where=f"recipe {name_or_path}")
    return recipe


def compose_runs(name_or_path: str | Path, overrides: Sequence[str]) -> list[RunRecipe]:
    """Compose one recipe for each combination of `key=a,b` (flag -m).

    Each run gets a numbered folder inside `run_dir`, or inside runs/<name>-grid.
    """
    recipes = [compose(name_or_path, run) for run in expand_sweeps(overrides)]
    return [
        dataclasses.replace(r, run_dir=f"{r.run_dir or f'runs/{r.name}-grid'}/{i}")
        for i, r in enumerate(recipes)
    ]


def inspect_recipe(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> tuple[RunRecipe, list[str]]:
    """Compose without raising: the recipe (unusable with problems) and the problems."""
    path = find_recipe(name_or_path)
    dirs = [path.parent, *(d for d in search_dirs() if d != path.parent)]
    groups = known_groups(dirs)
    parsed, problems = parse_overrides(overrides)
    named, broken = check_defaults(path, groups, problems)
    chosen = choose_groups(parsed, groups, problems)
    # A default that does not exist is taken out so that the rest can be checked,
    # unless the command line has replaced it.
    chosen = dict.fromkeys(broken) | chosen
    merged = _merge_files(path, dirs, hydra_choices(chosen, named), problems)
    apply_values(merged, parsed, groups, problems)
    data = _to_container(merged, problems)
    data.setdefault("name", path.stem)
    groups_used = named | chosen
    ablations = groups_used.get("ablation")
    if ablations:
        data["ablation"] = "+".join(ablations)
    data = mark_groups(data, [g for g, options in groups_used.items() if options])
    recipe, found = read_recipe(data)
    return recipe, problems + found


def load_recipe(path: str | Path, overrides: Sequence[str] = ()) -> RunRecipe:
    """Read a complete recipe, as `dump_recipe` wrote it, without composing.

    Args:
        path: the file, `recipe.yaml` of a run for example.
        overrides: values to change (`key=value`); groups cannot be chosen any more.
    """
    if not Path(path).is_file():
        raise FlashdexError(f"{path}: there is no such recipe file")
    try:
        config = OmegaConf.load(path)
    except (YAMLError, OmegaConfBaseException) as error:
        raise RecipeError([" ".join(str(error).split())], where=str(path)) from error
    if not isinstance(config, DictConfig):
        raise RecipeError(["expected keys and values"], where=str(path))
    return _change(config, overrides, where=str(path))


def dump_recipe(recipe: RunRecipe, path: str | Path | None = None) -> str:
    """Return the complete recipe as YAML, and write it when a path is given."""
    text = OmegaConf.to_yaml(OmegaConf.create(dataclasses.asdict(recipe)))
    if path is not None:
        Path(path).write_text(text)
    return text


def override_recipe(recipe: RunRecipe, overrides: Sequence[str]) -> RunRecipe:
    """Change values of a composed recipe."""
    config = OmegaConf.create(dataclasses.asdict(recipe))
    return _change(config, overrides, where=f"recipe {recipe.name}")


def _change(config: DictConfig, overrides: Sequence[str], *, where: str) -> RunRecipe:
    parsed, problems = parse_overrides(overrides)
    apply_values(config, parsed, {}, problems)
    recipe, found = read_recipe(_to_container(config, problems))
    if problems + found:
        raise RecipeError(problems + found, where=where)
    return recipe


def _merge_files(
    path: Path, dirs: list[Path], choices: list[str], problems: list[str]
) -> DictConfig:
    """Let Hydra merge the recipe with its groups; its complaint becomes a problem."""
    where = ",".join(f"'file://{folder}'" for folder in dirs[1:])
    search = f"hydra.searchpath=[{where}]"
    try:
        with hydra.initialize_config_dir(str(dirs[0]), version_base="1.3"):
            config = hydra.compose(path.stem, overrides=[search, *choices])
        OmegaConf.set_struct(config, False)
        merged = OmegaConf.merge(OmegaConf.create(kind_of(config).base), config)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        problems.append(f"{path.name}: {' '.join(str(error).split())}")
        return OmegaConf.create({})
    assert isinstance(merged, DictConfig)
    return merged


def _to_container(config: DictConfig, problems: list[str]) -> dict[str, Any]:
    try:
        data = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        problems.append(" ".join(str(error).split()))
        data = OmegaConf.to_container(config, resolve=False)
    return {str(k): v for k, v in data.items()} if isinstance(data, dict) else {}
