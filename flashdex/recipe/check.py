"""A plain mapping against the schema: the recipe, and everything wrong with it.

Nothing raises at the first mistake: a value that cannot be used is noted and its
default stands in, so that the rest is still checked.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from flashdex.algorithms.base import config_class
from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.mdp.term import KINDS, Kind, find_term, registry
from flashdex.errors import FlashdexError, RecipeError, nearest
from flashdex.recipe.schema import RunRecipe
from flashdex.recipe.tasks import split_foreign
from flashdex.system.fields import range_problem

R = TypeVar("R", bound=RunRecipe)
_NAMED: dict[str, Kind] = {f"env.{kind}": kind for kind in KINDS}
# Stand-ins for required values that are absent; the recipe is refused anyway.
_STAND_INS: dict[type, Any] = {int: 1, str: "", float: 1.0}


def read_recipe(data: Mapping[str, Any]) -> tuple[RunRecipe, list[str]]:
    """Turn a plain mapping into a recipe and list every problem in it.

    Args:
        data: the composed recipe, its kind by ``task``; keys that are absent take
            their default.

    Returns:
        The recipe (unusable when there are problems) and the problems, each with its
        YAML path.
    """
    problems: list[str] = []
    kind, own = split_foreign(data, problems)
    recipe = _read_dataclass(kind.root, own, "", problems)
    return recipe, problems + kind.find_conflicts(recipe)


def validate(recipe: R) -> R:
    """Check a recipe that was built in Python; all problems raise one RecipeError.

    Returns:
        The same recipe, with the options of every named part filled in.
    """
    complete, problems = read_recipe(dataclasses.asdict(recipe))
    if problems:
        raise RecipeError(problems, where=recipe.name)
    return typing.cast(R, complete)


def _join(path: str, key: object) -> str:
    return f"{path}.{key}" if path else str(key)


def _unknown(path: str, what: str, name: str, known: Iterable[str]) -> str:
    known = list(known)
    allowed = ", ".join(known) if known else "none"
    return f"{path}: unknown {what}.{nearest(name, known)} Allowed: {allowed}."


def _read_dataclass(cls: type, data: Any, path: str, problems: list[str]) -> Any:
    """Build one dataclass of the schema from a mapping."""
    if not isinstance(data, Mapping):
        problems.append(f"{path}: expected keys and values, found {data!r}")
        data = {}
    fields = {f.name: f for f in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    what = "argument" if any(path.startswith(f"{n}.") for n in _NAMED) else "key"
    for key in data:
        where = _join(path, key)
        if key == "_target_":
            problems.append(f"{where}: recipes name registered parts, never classes")
        elif key not in fields:
            problems.append(_unknown(where, what, str(key), fields))
    values = {
        name: _read_field(field, hints[name], data, _join(path, name), problems)
        for name, field in fields.items()
    }
    return cls(**values)


def _read_field(
    field: dataclasses.Field[Any],
    hint: Any,
    data: Mapping[str, Any],
    path: str,
    problems: list[str],
) -> Any:
    """Read one field: its value, or its default when absent or wrong."""
    if field.default is not dataclasses.MISSING:
        default = field.default
    elif field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    else:
        default = _STAND_INS[hint]
        if field.name not in data:
            problems.append(f"{path}: missing; every recipe must give it")
            return default
    if path in _NAMED:
        return _read_named(_NAMED[path], data.get(field.name, default), path, problems)
    if field.name not in data:
        return default
    value, problem = _convert(hint, data[field.name], path, problems)
    if problem is None and isinstance(value, int | float):
        problem = range_problem(field, value)
    if problem is not None:
        problems.append(f"{path}: {problem}")
        return default
    return value


def _read_named(
    kind: Kind, data: Any, path: str, problems: list[str]
) -> dict[str, Any]:
    """Read a named mapping of parts; the options of each are filled in."""
    if not isinstance(data, Mapping):
        problems.append(f"{path}: expected names and options, found {data!r}")
        return {}
    known = registry(kind)
    result: dict[str, Any] = {}
    for name, options in data.items():
        where, target = _join(path, name), {}
        is_shipped = name in known and known[name].is_shipped
        if isinstance(options, Mapping) and not is_shipped:
            target = {k: v for k, v in options.items() if k == "_target_"}
            options = {k: v for k, v in options.items() if k != "_target_"}
        if name not in known and not target:
            problems.append(_unknown(where, kind[:-1], str(name), known))
            continue
        try:
            term = find_term(kind, name, target)
        except FlashdexError as error:
            problems.append(f"{where}: unknown {kind[:-1]}. {error}")
            continue
        result[name] = None
        if options is not None:
            part = _read_dataclass(term.options, options, where, problems)
            result[name] = target | dataclasses.asdict(part)
    return result


def _convert(
    hint: Any, value: Any, path: str, problems: list[str]
) -> tuple[Any, str | None]:
    """Return the value as the type wants it, or say why that is impossible."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None:
            return None, None
        inner = next(arg for arg in args if arg is not type(None))
        return _convert(inner, value, path, problems)
    if origin is Literal:
        if value in args:
            return value, None
        close = nearest(str(value), [str(arg) for arg in args])
        allowed = ", ".join(map(str, args))
        return None, f"{value!r} is not allowed.{close} Allowed: {allowed}."
    if origin is list:
        return _convert_list(args[0], value, path, problems)
    if dataclasses.is_dataclass(hint):
        cls = typing.cast(type, hint)
        if cls is AlgoConfig and isinstance(value, Mapping):
            cls = config_class(value.get("kind"))  # an algorithm may add keys
        return _read_dataclass(cls, value, path, problems), None
    return _convert_scalar(hint, value)


def _convert_list(
    hint: Any, value: Any, path: str, problems: list[str]
) -> tuple[Any, str | None]:
    if not isinstance(value, list | tuple):
        return None, f"expected a list, found {value!r}"
    items = []
    for i, entry in enumerate(value):
        item, problem = _convert(hint, entry, f"{path}[{i}]", problems)
        if problem is not None:
            return None, f"item {i}: {problem}"
        items.append(item)
    return items, None


def _convert_scalar(hint: type, value: Any) -> tuple[Any, str | None]:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and is_number:
        return float(value), None
    # 3e8 is a float in YAML; a whole one is meant as an integer.
    if hint is int and is_number and float(value).is_integer():
        return int(value), None
    if hint in (bool, str) and isinstance(value, hint):
        return value, None
    names = {int: "an integer", float: "a number", bool: "true or false", str: "text"}
    return None, f"expected {names[hint]}, found {value!r}"
