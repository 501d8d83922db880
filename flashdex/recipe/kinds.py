"""The kinds of recipes: what can be trained, told apart by the key ``task``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from flashdex.envs.mdp.options import REGISTRY, default_mapping
from flashdex.errors import FlashdexError, nearest
from flashdex.recipe.gym import GymRecipe, find_gym_conflicts
from flashdex.recipe.relations import find_conflicts
from flashdex.recipe.schema import Recipe, RunRecipe

R = TypeVar("R", bound=RunRecipe)


@dataclass(frozen=True)
class Kind:
    """One kind of recipe."""

    root: type[RunRecipe]
    """Its schema."""
    find_conflicts: Callable[[Any], list[str]]
    """Says what does not fit together in one."""
    base: dict[str, Any]
    """What its files are merged onto: all named parts with no option set."""


DEFAULT_TASK = "retarget"
KINDS: dict[str, Kind] = {
    DEFAULT_TASK: Kind(
        root=Recipe,
        find_conflicts=find_conflicts,
        base={"env": {kind: default_mapping(kind) for kind in REGISTRY}},
    ),
    "gym": Kind(root=GymRecipe, find_conflicts=find_gym_conflicts, base={}),
}


def kind_of(data: Mapping[str, Any]) -> Kind:
    """Return the kind a mapping asks for; an unknown task counts as the default."""
    return KINDS.get(str(data.get("task")), KINDS[DEFAULT_TASK])


def split_foreign(
    data: Mapping[str, Any], problems: list[str]
) -> tuple[Kind, dict[str, Any]]:
    """Find the kind of a recipe and take out what belongs to another kind.

    Args:
        data: the composed recipe.
        problems: where an unknown task and foreign keys are noted.

    Returns:
        The kind, and the mapping without foreign keys and unknown tasks.
    """
    kept = dict(data)
    task = data.get("task", DEFAULT_TASK)
    if task not in KINDS:
        problems.append(
            f"task: {task!r} is not a task.{nearest(str(task), KINDS)} "
            f"Allowed: {', '.join(KINDS)}."
        )
        kept.pop("task")
        task = DEFAULT_TASK
    own = _keys(KINDS[task])
    for key in data:
        homes = [name for name, kind in KINDS.items() if key in _keys(kind)]
        if key not in own and homes:
            problems.append(
                f"{key}: belongs to recipes with task: {homes[0]}, this one has "
                f"task: {task}; take it out"
            )
            kept.pop(key)
    return KINDS[task], kept


def mark_groups(data: Mapping[str, Any], groups: Iterable[str]) -> dict[str, Any]:
    """Add the groups that belong to another kind, or one without a value passes unseen.

    Args:
        data: the composed recipe.
        groups: those it chose an option of.
    """
    own = _keys(kind_of(data))
    return {**{group: None for group in groups if group not in own}, **data}


def _keys(kind: Kind) -> set[str]:
    return {field.name for field in dataclasses.fields(kind.root)}


def expect_kind(recipe: RunRecipe, root: type[R], *, where: str) -> R:
    """Return the recipe if it is of one kind.

    Args:
        recipe: any validated recipe.
        root: schema of the kind that is needed.
        where: who needs it, for the message.

    Raises:
        FlashdexError: it is of another kind.
    """
    if isinstance(recipe, root):
        return recipe
    wanted = next(name for name, kind in KINDS.items() if kind.root is root)
    raise FlashdexError(
        f"{where}: needs a recipe with task: {wanted}; '{recipe.name}' is of another "
        "kind. `flashdex ls` says what each recipe trains."
    )


def task_of_run(run_dir: Path) -> str:
    """Return the task of a run directory; the default where none is stated."""
    try:
        data = yaml.safe_load((run_dir / "recipe.yaml").read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError):
        return DEFAULT_TASK  # the verb itself says what is wrong with the folder
    task = data.get("task") if isinstance(data, dict) else None
    return task if task in KINDS else DEFAULT_TASK


def require_motions(run_dir: Path) -> None:
    """Refuse a run that has none.

    Raises:
        FlashdexError: it trains on a stock environment.
    """
    if task_of_run(run_dir) == "gym":
        raise FlashdexError(
            f"{run_dir}: a run with task: gym has no motions. Its figures are in "
            "metrics.jsonl; `flashdex evaluate` makes new ones."
        )
