"""Check recipe files and folders: `flashdex validate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flashdex.errors import FlashdexError, RecipeError
from flashdex.recipe.compose import inspect_recipe
from flashdex.recipe.store import find_recipe


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
