"""Where recipes lie: a path, ./recipes, the recipes inside the package; what a run is.

Nothing here imports the schema, which would import torch.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flashdex
from flashdex.errors import (
    FlashdexError,
    RecipeError,
    UnknownOptionError,
    UnknownRecipeError,
    nearest,
)
from flashdex.recipe.reader import parse_yaml, read_text, read_yaml

DEFAULT_TASK, GYM_TASK, SEARCH_TASK = "retarget", "gym", "search"


@dataclass(frozen=True)
class RecipeEntry:
    """One line of `flashdex ls`."""

    name: str
    """Name to train it by."""
    path: Path
    """The file."""
    headline: str
    """First comment line: what it is."""
    expect: list[dict[str, Any]]
    """Promised numbers."""
    problem: str = ""
    """Why it cannot be read, empty where it can."""


def package_dir() -> Path:
    """Return the recipes of the installed package or of the checkout."""
    package = Path(flashdex.__path__[0])
    installed = package / "recipes"
    return installed if installed.is_dir() else package.parent / "recipes"


def search_dirs() -> list[Path]:
    """Return the folders a name is looked up in, first match wins."""
    dirs = [package_dir().resolve()]
    with contextlib.suppress(FileNotFoundError):  # the folder we are in was removed
        dirs.insert(0, Path("recipes").resolve())
    return [d for i, d in enumerate(dirs) if d.is_dir() and d not in dirs[:i]]


def find_recipe(name_or_path: str | Path) -> Path:
    """Return the file of a recipe.

    Args:
        name_or_path: a name (`quickstart`) or the path of a YAML file.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if is_file(path):
            return path.resolve()
        raise FlashdexError(
            f"recipe {path}: there is no such file.{_what_was_meant(path)} Give the "
            f"path of a YAML file or one of the names that `flashdex ls` lists."
        )
    for folder in search_dirs():
        if is_file(folder / f"{text}.yaml"):
            return folder / f"{text}.yaml"
    raise UnknownRecipeError(text, [entry.name for entry in list_recipes()])


def _what_was_meant(path: Path) -> str:
    """A hint for who gave a path at which no recipe lies."""
    if is_file(path / "recipe.yaml"):
        return f" It is the folder of a run, whose recipe is {path / 'recipe.yaml'}."
    named = str(path.with_suffix(""))
    names = [f"{group}/{o}" for group, some in known_groups().items() for o in some]
    if named in names:
        return f" It is an option: add {named.replace('/', '=')} to a recipe."
    names += [entry.name for entry in list_recipes()]
    return nearest(named, names) or nearest(path.stem, names)


def is_file(path: Path) -> bool:
    """Whether it is a regular file; a name that no file can have is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, not to be entered, with NUL in it
        return False


def find_option(name: str | Path) -> Path | None:
    """Return the file of an option by name, `ablation/no_future`; None if none is."""
    group, _, option = str(name).removesuffix(".yaml").partition("/")
    for folder in search_dirs() if option and "/" not in option else ():
        if is_file(folder / group / f"{option}.yaml"):
            return folder / group / f"{option}.yaml"
    known = known_groups()
    if group in known and option and not is_file(Path(name)):
        raise UnknownOptionError(option, known[group], where=group)
    return None


def recipe_files(path: str | Path) -> list[Path]:
    """Return the file of a recipe or an option, or the YAML files of a folder.

    Raises:
        FlashdexError: there is none.
    """
    if not Path(path).is_dir():
        return [find_option(path) or find_recipe(path)]
    files = sorted(Path(path).glob("*.yaml"))
    if not files:
        raise FlashdexError(f"{path}: no recipe (*.yaml) in this folder")
    return files


def group_of(path: Path) -> str | None:
    """Return the group that a file is an option of; None for a recipe.

    Raises:
        RecipeError: it cannot be read.
    """
    text, group = read_text(path), path.resolve().parent.name
    if "# @package " in text:
        return group
    is_whole = "total_env_steps" in text  # every recipe gives it, an option need not
    return group if group in known_groups() and not is_whole else None


def known_groups(folder: Path | None = None) -> dict[str, list[str]]:
    """Return group name to its options, over all folders of the search path.

    Args:
        folder: that of a recipe. It may be any of the user's, so it adds options, but
            no groups.
    """
    dirs = search_dirs()
    names = {path.parent.name for d in dirs for path in d.glob("*/*.yaml")}
    groups: dict[str, set[str]] = {}
    for path in [p for d in (folder, *dirs) if d for p in d.glob("*/*.yaml")]:
        if path.parent.name in names and is_file(path):
            groups.setdefault(path.parent.name, set()).add(path.stem)
    return {name: sorted(options) for name, options in sorted(groups.items())}


def list_recipes() -> list[RecipeEntry]:
    """Return every recipe that can be trained by name, sorted by name."""
    return _list("*.yaml")


def list_options() -> dict[str, list[RecipeEntry]]:
    """Return the options of every group, by the name of the group."""
    return {group: _list(f"{group}/*.yaml") for group in known_groups()}


def _list(pattern: str) -> list[RecipeEntry]:
    found: dict[str, RecipeEntry] = {}
    for folder in search_dirs():
        for path in sorted(folder.glob(pattern)):
            found.setdefault(path.stem, _read_entry(path))
    return [found[name] for name in sorted(found)]


def _read_entry(path: Path) -> RecipeEntry:
    """What a file says of itself; what is wrong with it is said, never raised."""
    try:
        text = read_text(path)
        data, problem = parse_yaml(text, where=path.stem), ""
    except RecipeError as error:
        text, data, problem = "", {}, error.problems[0]
    comments = [line[1:].strip() for line in text.splitlines() if line.startswith("#")]
    said = [line for line in comments if not line.startswith("@package")]
    expect = data.get("expect")
    return RecipeEntry(
        name=path.stem,
        path=path,
        headline=said[0] if said else "",
        expect=[e for e in expect if isinstance(e, dict)]
        if isinstance(expect, list)
        else [],
        problem=problem,
    )


def format_listing(entries: list[RecipeEntry]) -> str:
    """Lay recipes out as text: name and headline, below it the promised numbers."""
    width = max((len(entry.name) for entry in entries), default=0)
    lines = []
    for entry in entries:
        said = f"BROKEN: {entry.problem}" if entry.problem else entry.headline
        lines.append(f"{entry.name:<{width}}  {said}".rstrip())
        lines += [f"{'':<{width}}    expects {_promise(e)}" for e in entry.expect]
    return "\n".join(lines)


def _promise(entry: dict[str, Any]) -> str:
    bounds = [
        f"{sign} {entry[key]:g}"
        for key, sign in (("min", ">="), ("max", "<="))
        if isinstance(entry.get(key), int | float)
    ]
    steps = entry.get("at_env_steps")
    at = f" at {steps:,} env steps" if isinstance(steps, int) else ""
    return f"{entry.get('metric')} {' and '.join(bounds)}{at}"


def copy_recipe(name_or_path: str | Path, destination: str | Path) -> Path:
    """Copy a recipe, or an option of a group, never over an existing file.

    Args:
        name_or_path: the recipe, or `group/option`.
        destination: a new file, or a folder: one that exists or ends with a slash.

    Returns:
        The new file.
    """
    source = find_option(name_or_path) or find_recipe(name_or_path)
    text, target = read_text(source), Path(destination)
    if target.is_dir() or str(destination).endswith("/"):
        target = target / source.name
    if target.suffix not in (".yaml", ".yml"):
        target = target.with_name(f"{target.name}.yaml")
    if os.path.lexists(target):
        raise FlashdexError(f"{target}: exists already; choose another name")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    except (OSError, ValueError) as error:
        raise FlashdexError(f"{target}: cannot be written ({error})") from error
    return target


def task_of_run(run_dir: Path) -> str:
    """Return the task of a run directory; the default where none is stated."""
    try:
        data = read_yaml(run_dir / "recipe.yaml")
    except RecipeError:
        return DEFAULT_TASK  # the verb itself says what is wrong with the folder
    return GYM_TASK if data.get("task") == GYM_TASK else DEFAULT_TASK


def require_motions(run_dir: Path) -> None:
    """Refuse a run that has none.

    Raises:
        FlashdexError: it trains on a stock environment.
    """
    if task_of_run(run_dir) == GYM_TASK:
        raise FlashdexError(
            f"{run_dir}: a run with task: gym has no motions. Its figures are in "
            "metrics.jsonl; `flashdex evaluate` makes new ones."
        )
