"""From a recipe's name and overrides to a checked recipe.

Hydra merges the files (defaults list, groups, ablations); values, defaults and names
are then checked here against the dataclasses, because Hydra would stop at the first
mistake.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from flashdex.errors import FlashdexError, RecipeError, nearest
from flashdex.recipe.check import read_recipe
from flashdex.recipe.schema import RunRecipe
from flashdex.recipe.store import find_recipe, search_dirs
from flashdex.recipe.tasks import kind_of, mark_groups

Groups = dict[str, list[str]]


def known_groups(dirs: Sequence[Path]) -> Groups:
    """Return group name to its options, over all folders of the search path.

    Args:
        dirs: folder of the recipe first, then where names are looked up. The first
            may be any folder of the user's, so it adds options but no groups.
    """
    groups: dict[str, set[str]] = {}
    names = {path.parent.name for d in search_dirs() for path in d.glob("*/*.yaml")}
    for folder in dirs:
        for path in folder.glob("*/*.yaml"):
            if path.parent.name in names:
                groups.setdefault(path.parent.name, set()).add(path.stem)
    return {name: sorted(options) for name, options in sorted(groups.items())}


def check_option(group: str, option: str, groups: Groups, problems: list[str]) -> bool:
    """Note a group or an option that does not exist; say whether both do."""
    if group not in groups:
        problems.append(
            f"defaults.{group}: unknown group.{nearest(group, groups)} "
            f"Allowed: {', '.join(groups)}."
        )
    elif option not in groups[group]:
        problems.append(
            f"{group}={option}: there is no such {group}."
            f"{nearest(option, groups[group])} Allowed: {', '.join(groups[group])}."
        )
    else:
        return True
    return False


def check_defaults(
    path: Path, groups: Groups, problems: list[str]
) -> tuple[dict[str, list[str]], list[str]]:
    """Check the defaults list of one file.

    Args:
        path: the recipe.
        groups: what exists.
        problems: where problems are noted.

    Returns:
        The options of each group it names, and the groups with a wrong option.
    """
    named: dict[str, list[str]] = {}
    broken: list[str] = []
    has_self = False
    for entry in _read_defaults(path):
        has_self = has_self or entry == "_self_"
        for key, value in entry.items() if isinstance(entry, dict) else ():
            *words, group = str(key).replace("/", " ").split()
            _check_entry(group, words, has_self, problems)
            options = [str(v) for v in (value if isinstance(value, list) else [value])]
            good = [check_option(group, o, groups, problems) for o in options]
            named[group] = options
            if not all(good):
                broken.append(group)
    return named, broken


def _check_entry(
    group: str, words: list[str], has_self: bool, problems: list[str]
) -> None:
    """Note the two ways in which Hydra would drop a choice without a word."""
    if "optional" in words:
        problems.append(
            f"defaults.{group}: 'optional' hides a misspelt option; leave it out (use "
            f"'{group}: none' for nothing)"
        )
    if group == "ablation" and not has_self:
        problems.append(
            "defaults: '_self_' must stand before 'ablation', or the recipe wins and "
            "the ablation has no effect"
        )


def _read_defaults(path: Path) -> list[Any]:
    try:
        data = yaml.safe_load(path.read_text())
    except yaml.YAMLError:
        return []  # Hydra reads it next and says where the syntax is wrong
    entries = data.get("defaults") if isinstance(data, dict) else None
    return entries if isinstance(entries, list) else []


def parse_overrides(texts: Sequence[str]) -> tuple[list[Override], list[str]]:
    """Parse each override on its own; return the good ones and the problems."""
    parser = OverridesParser.create()
    parsed: list[Override] = []
    problems: list[str] = []
    for text in texts:
        try:
            override = parser.parse_override(text)
        except HydraException:
            problems.append(
                f"override '{text}': not understood; write key=value, ~key or "
                f"group=option"
            )
            continue
        if override.is_sweep_override():
            problems.append(f"override '{text}': several values need the flag -m")
            continue
        parsed.append(override)
    return parsed, problems


def expand_sweeps(texts: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides a run: the product of all `key=a,b` (flag -m).

    Example:
        >>> expand_sweeps(["seed=0,1", "hand=xhand"])
        [['seed=0', 'hand=xhand'], ['seed=1', 'hand=xhand']]
    """
    parser = OverridesParser.create()
    choices: list[list[str]] = []
    for text in texts:
        try:
            override = parser.parse_override(text)
        except HydraException as error:
            raise RecipeError([f"override '{text}': not understood"]) from error
        if override.is_sweep_override():
            key = override.get_key_element()
            choices.append([f"{key}={v}" for v in override.sweep_string_iterator()])
        else:
            choices.append([text])
    return [list(run) for run in itertools.product(*choices)]


def choose_groups(
    parsed: Sequence[Override], groups: Groups, problems: list[str]
) -> dict[str, list[str] | None]:
    """Return the options chosen for each group; None takes the group out.

    Args:
        parsed: all overrides.
        groups: groups and their options.
        problems: where unknown options are noted; those choices are left out.
    """
    chosen: dict[str, list[str] | None] = {}
    for override in parsed:
        group = override.key_or_group
        if group not in groups:
            continue
        if override.is_delete():
            chosen[group] = None
            continue
        value = override.value()
        options = [str(v) for v in (value if isinstance(value, list) else [value])]
        # A list, so that every wrong option is noted, not only the first.
        good = [check_option(group, option, groups, problems) for option in options]
        if all(good):
            chosen[group] = options
    return chosen


def hydra_choices(
    chosen: Mapping[str, list[str] | None], named: Collection[str]
) -> list[str]:
    """Write group choices as Hydra overrides.

    Args:
        chosen: options a group; None takes the group out.
        named: groups in the recipe's own defaults list. Others are appended, which
            puts them behind `_self_`.
    """
    texts: list[str] = []
    for group, options in chosen.items():
        if options is None:
            texts += [f"~{group}"] if group in named else []
        else:
            add = "" if group in named else "+"
            value = options[0] if len(options) == 1 else f"[{','.join(options)}]"
            texts.append(f"{add}{group}={value}")
    return texts


def apply_values(
    config: DictConfig,
    parsed: Sequence[Override],
    groups: Groups,
    problems: list[str],
) -> None:
    """Apply the overrides that set or delete a value, in place."""
    for override in parsed:
        key = override.key_or_group
        if key in groups:
            continue
        try:
            if override.is_delete():
                _delete(config, key)
            else:
                OmegaConf.update(config, key, override.value(), force_add=True)
        except (OmegaConfBaseException, KeyError, TypeError, AttributeError) as error:
            detail = error.args[0] if isinstance(error, KeyError) else "no such place"
            problems.append(f"override '{override.input_line}': {detail}")


def _delete(config: DictConfig, key: str) -> None:
    parent_key, _, name = key.rpartition(".")
    parent = OmegaConf.select(config, parent_key) if parent_key else config
    known = [str(k) for k in parent] if isinstance(parent, DictConfig) else []
    if name not in known:
        allowed = f" There are: {', '.join(known)}." if known else ""
        raise KeyError(f"{key} does not exist.{nearest(name, known)}{allowed}")
    del parent[name]


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
        merged = OmegaConf.merge(OmegaConf.create(kind_of(config).make_base()), config)
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


def validate_paths(paths: Sequence[str | Path]) -> list[Path]:
    """Compose every recipe; all problems of all files are raised together.

    Args:
        paths: recipe names, files or folders (the YAML files at their top level).

    Returns:
        The files that were checked.
    """
    files = [file for path in paths for file in _files(path)]
    problems = []
    for file in files:
        _, found = inspect_recipe(file)
        problems += [f"{file}: {problem}" for problem in found]
    if problems:
        raise RecipeError(problems, where=f"{len(files)} recipes checked")
    return files


def _files(path: str | Path) -> list[Path]:
    if not Path(path).is_dir():
        return [find_recipe(path)]
    files = sorted(Path(path).glob("*.yaml"))
    if not files:
        raise FlashdexError(f"{path}: no recipe (*.yaml) in this folder")
    return files
