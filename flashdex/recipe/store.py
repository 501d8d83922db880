"""Where recipes lie: a path, ./recipes, the recipes inside the package; what a run is.

Nothing here imports the schema, which would import torch.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

import flashdex
from flashdex.errors import FlashdexError, UnknownRecipeError

DEFAULT_TASK, GYM_TASK = "retarget", "gym"


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


def package_dir() -> Path:
    """Return the recipes of the installed package or of the checkout."""
    package = Path(flashdex.__path__[0])
    installed = package / "recipes"
    return installed if installed.is_dir() else package.parent / "recipes"


def search_dirs() -> list[Path]:
    """Return the folders a name is looked up in, first match wins."""
    local = Path.cwd() / "recipes"
    dirs = [local.resolve(), package_dir().resolve()]
    return [d for i, d in enumerate(dirs) if d.is_dir() and d not in dirs[:i]]


def find_recipe(name_or_path: str | Path) -> Path:
    """Return the file of a recipe.

    Args:
        name_or_path: a name (`quickstart`) or the path of a YAML file.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if path.is_file():
            return path.resolve()
        raise FlashdexError(
            f"recipe {path}: there is no such file. Give the path of a YAML file or "
            f"one of the names that `flashdex ls` lists."
        )
    for folder in search_dirs():
        if (folder / f"{text}.yaml").is_file():
            return folder / f"{text}.yaml"
    raise UnknownRecipeError(text, [entry.name for entry in list_recipes()])


def list_recipes() -> list[RecipeEntry]:
    """Return every recipe that can be trained by name, sorted by name."""
    found: dict[str, RecipeEntry] = {}
    for folder in search_dirs():
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, _read_entry(path))
    return [found[name] for name in sorted(found)]


def _read_entry(path: Path) -> RecipeEntry:
    text = path.read_text()
    comments = [line[1:].strip() for line in text.splitlines() if line.startswith("#")]
    try:
        data = yaml.safe_load(text) or {}
    except yaml.YAMLError:  # `flashdex validate` says what is wrong with it
        data = {}
    return RecipeEntry(
        name=path.stem,
        path=path,
        headline=comments[0] if comments else "",
        expect=list(data.get("expect") or []),
    )


def format_listing(entries: list[RecipeEntry]) -> str:
    """Lay recipes out as text: name and headline, below it the promised numbers."""
    width = max((len(entry.name) for entry in entries), default=0)
    lines = []
    for entry in entries:
        lines.append(f"{entry.name:<{width}}  {entry.headline}")
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
    """Copy a recipe to a file or into a folder, never over an existing file.

    Args:
        name_or_path: the recipe.
        destination: a new file, or an existing folder.

    Returns:
        The new file.
    """
    source = find_recipe(name_or_path)
    target = Path(destination)
    if target.is_dir():
        target = target / source.name
    if target.suffix not in (".yaml", ".yml"):
        target = target.with_name(f"{target.name}.yaml")
    if target.exists():
        raise FlashdexError(f"{target}: exists already; choose another name")
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return target


def task_of_run(run_dir: Path) -> str:
    """Return the task of a run directory; the default where none is stated."""
    try:
        data = yaml.safe_load((run_dir / "recipe.yaml").read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError):
        return DEFAULT_TASK  # the verb itself says what is wrong with the folder
    task = data.get("task") if isinstance(data, dict) else None
    return GYM_TASK if task == GYM_TASK else DEFAULT_TASK


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
