"""A plain mapping against the schema: the recipe, and everything wrong with it.

pydantic reads the dataclasses. Nothing raises at the first mistake: a value that cannot
be used is noted and its default stands in, so that the rest is still checked.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import operator
import re
import typing
from collections.abc import Iterable, Mapping
from types import GenericAlias
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from flashdex.algorithms.base import config_class
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp.term import KINDS, Kind, default_mapping, find_term, registry
from flashdex.errors import FlashdexError, RecipeError, nearest
from flashdex.recipe.overrides import PATHS
from flashdex.recipe.schema import RunRecipe
from flashdex.recipe.tasks import split_foreign

R = TypeVar("R", bound=RunRecipe)
_NAME_BYTES, _PATH_BYTES = 100, 2000
MAX_PROBLEMS = 10  # of one look at a recipe that are told
# Stand-ins for required values that are absent; the recipe is refused anyway.
_STAND_INS: dict[type, Any] = {int: 1, str: "", float: 1.0}
_EXPECTED = {
    "int_type": "an integer",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "dataclass_type": "keys and values",
}
_RANGES = {"gt": "greater than", "ge": "at least", "le": "at most"}


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
    algo, env = own.pop("algo", {}), own.pop("env", {})
    recipe: Any = build_config(kind.root, own, "", problems)
    if "env" in kind.keys:
        recipe = dataclasses.replace(recipe, env=_read_env(env, problems))
    # An algorithm may add keys.
    cls = config_class(algo.get("kind") if isinstance(algo, Mapping) else None)
    recipe = dataclasses.replace(recipe, algo=build_config(cls, algo, "algo", problems))
    noted = [problem.partition(": ")[0] for problem in problems]
    found = _find_names(recipe) + kind.find_conflicts(recipe)
    # what only the stand-in of a wrong value does not fit is no mistake
    return recipe, problems + [f for f in found if not _names_any(f, noted)]


def _names_any(problem: str, keys: Iterable[str]) -> bool:
    """Whether a text speaks of one of some keys, not of one that begins like it."""
    return any(re.search(rf"(?<![\w.]){re.escape(k)}(?![\w.])", problem) for k in keys)


def _find_names(recipe: RunRecipe) -> list[str]:
    """Return one line for each text that no file or folder can be called by."""
    problems = []
    for key in ("name", "ablation"):  # parts of the name of the run's folder
        text = getattr(recipe, key)
        if not text.strip() or "/" in text or text.startswith(".") or not _fits(text):
            problems.append(
                f"{key}: {_shown(text)} cannot be part of a folder's name; give up to "
                f"{_NAME_BYTES} bytes without '/', not beginning with a dot"
            )
    for key in PATHS:
        path: Any = functools.reduce(
            lambda part, word: getattr(part, word, None), key.split("."), recipe
        )
        long = max(path.split("/"), key=len) if path is not None else ""
        if path is not None and (
            not path.strip() or len(path) > _PATH_BYTES or not _fits(long, 255)
        ):
            problems.append(f"{key}: {_shown(path)} cannot be a path; null is none")
    return problems


def _fits(text: str, size: int = _NAME_BYTES) -> bool:
    """Whether a text can be shown, and written as the name of a file."""
    return text.isprintable() and len(text.encode(errors="replace")) <= size


def validate(recipe: R) -> R:
    """Check a recipe that was built in Python; all problems raise one RecipeError.

    Returns:
        The same recipe, with the options of every named part filled in.
    """
    complete, problems = read_recipe(dataclasses.asdict(recipe))
    if problems:
        raise RecipeError(problems, where=recipe.name)
    return typing.cast(R, complete)


def check_option(cls: type, key: str, value: Any, *, where: str) -> None:
    """Refuse one value of a dataclass whose other values have defaults."""
    problems: list[str] = []
    build_config(cls, {key: value}, "", problems)
    if problems:
        raise RecipeError(problems, where=where)


def _read_env(data: Any, problems: list[str]) -> EnvConfig:
    """Read the environment, whose terms are registered by name."""
    if not isinstance(data, Mapping):
        return build_config(EnvConfig, data, "env", problems)
    plain = {key: value for key, value in data.items() if key not in KINDS}
    terms = {kind: _read_terms(kind, data, problems) for kind in KINDS}
    env = build_config(EnvConfig, plain, "env", problems)
    return dataclasses.replace(env, **terms)


def _read_terms(
    kind: Kind, env: Mapping[str, Any], problems: list[str]
) -> dict[str, Any]:
    """Read the terms of a kind; the options of each are filled in."""
    data = env.get(kind, default_mapping(kind))
    if not isinstance(data, Mapping):
        problems.append(f"env.{kind}: expected names and options, found {data!r}")
        return {}
    known = registry(kind)
    result: dict[str, Any] = {}
    for name, options in data.items():
        where, target = f"env.{kind}.{name}", {}
        is_shipped = name in known and known[name].is_shipped
        if isinstance(options, Mapping) and not is_shipped:
            target = {k: v for k, v in options.items() if k == "_target_"}
            options = {k: v for k, v in options.items() if k != "_target_"}
        if name not in known and not target:
            problems.append(f"{where}: {_unknown(kind[:-1], str(name), known)}")
            continue
        try:
            term = find_term(kind, name, target)
        except FlashdexError as error:
            problems.append(f"{where}: unknown {kind[:-1]}. {error}")
            continue
        result[name] = options
        if options is not None:
            part = build_config(term.options, options, where, problems)
            result[name] = target | dataclasses.asdict(part)
    return result


def _unknown(what: str, name: str, known: Iterable[str], below: str = "") -> str:
    allowed = ", ".join(known) or "none"
    close = f" Did you mean '{below}'?" if below else nearest(name, known)
    return f"unknown {what}.{close} Allowed: {allowed}."


def _below(cls: type, key: str) -> str:
    """Where a key is known that was written without its group; empty where nowhere."""
    for group, hint in get_type_hints(cls).items():
        inner = dataclasses.fields(hint) if dataclasses.is_dataclass(hint) else ()
        if any(field.name == key for field in inner):
            return f"{group}.{key}"
    return ""


@functools.cache
def _adapter(cls: type) -> TypeAdapter[Any]:
    # In a tuple, as pydantic takes no configuration of a bare dataclass.
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    alone: Any = GenericAlias(tuple, (cls,))
    return TypeAdapter(alone, config=config)


def _whole(text: str) -> float:
    """A number of JSON: 3e8 is a float in YAML, but is meant as an integer."""
    value = float(text)
    return int(value) if value.is_integer() else value


def build_config(cls: type, data: Any, path: str, problems: list[str]) -> Any:
    """Build a dataclass; what is wrong is noted and taken out, the rest read again."""
    text = json.dumps([data], default=lambda value: {type(value).__name__: repr(value)})
    root, noted = json.loads(text, parse_float=_whole), set()
    for _ in range(6):  # absent values and their stand-ins show in later rounds
        try:
            # Strict, or "1" were a number; in JSON a mapping still is a dataclass.
            return _adapter(cls).validate_json(json.dumps(root), strict=True)[0]
        except ValidationError as found:
            if not found.errors()[0]["loc"]:
                raise RecipeError([f"{path}: a text in it is not Unicode"]) from found
            errors = found.errors()
            for error in errors[:MAX_PROBLEMS]:
                where, problem = _explain(cls, error, path)
                if where not in noted:
                    problems.append(f"{where}: {problem}")
                noted.add(where)
                _replace(cls, root, error)
            # each name is compared with all known ones: minutes for thousands
            for error in errors[MAX_PROBLEMS:]:
                _replace(cls, root, error)
            if len(errors) > MAX_PROBLEMS:
                problems.append(
                    f"{path}: {len(errors) - MAX_PROBLEMS} more of this kind"
                )
    raise RecipeError(problems)  # a required value has no stand-in


def _explain(cls: type, error: Any, path: str) -> tuple[str, str]:
    """Where a mistake is and what it is, in the words of recipes."""
    (_, *way), kind, value = error["loc"], error["type"], error["input"]
    item = f"item {way.pop()}: " if _is_item(error) else ""
    words = [f"[{key}]" if isinstance(key, int) else f".{key}" for key in way]
    where = f"{path}{''.join(words)}".removeprefix(".")
    limits = error.get("ctx", {})
    if kind == "missing":
        return where, "missing; every recipe must give it"
    if kind == "unexpected_keyword_argument" and way[-1] == "_target_":
        return where, "recipes name registered parts, never classes"
    if kind == "unexpected_keyword_argument":
        known = [field.name for field in dataclasses.fields(_owner(cls, way[:-1]))]
        what = "argument" if path.startswith("env.") else "key"
        return where, _unknown(what, way[-1], known, _below(cls, where))
    if kind == "literal_error":
        known = re.findall(r"'([^']*)'|\b(\d+)\b", limits["expected"])
        known = [text or digits for text, digits in known]
        problem = f"{_shown(value)} is not allowed.{nearest(str(value)[:99], known)} "
        return where, f"{item}{problem}Allowed: {', '.join(known)}."
    for key in _RANGES.keys() & limits:
        limit = f"{limits[key]:.12g}"
        return where, f"{item}{_shown(value)} must be {_RANGES[key]} {limit}"
    expected = _EXPECTED.get(kind, error["msg"])
    if kind in ("too_short", "too_long"):
        least, most = limits.get("min_length"), limits.get("max_length")
        expected = f"at least {least} entries" if least else f"at most {most} entries"
    return where, f"{item}expected {expected}, found {_shown(value)}"


def _shown(value: Any) -> str:
    """A value as messages show it: on one line, and not all of a long one."""
    text = ascii(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:50]}...{text[-8:]}"


def _is_item(error: Any) -> bool:
    """Whether it is a plain item of a list, which is then refused as a whole."""
    return isinstance(error["loc"][-1], int) and error["type"] != "dataclass_type"


def _replace(cls: type, root: list[Any], error: Any) -> None:
    """Put a stand-in where something is missing, and take out what is wrong."""
    *way, key = error["loc"]
    if _is_item(error):
        *way, key = way
    place: Any = functools.reduce(operator.getitem, way, root)
    if error["type"] == "missing":
        place[key] = _STAND_INS.get(get_type_hints(_owner(cls, way[1:]))[key])
    elif error["type"] == "dataclass_type":
        place[key] = {}
    else:
        place.pop(key, None)


def _owner(cls: Any, way: list[int | str]) -> Any:
    """The dataclass that is found along some keys."""
    for key in way:
        if isinstance(key, str):
            hint = get_type_hints(cls)[key]
            cls = next(
                o for o in (hint, *get_args(hint)) if dataclasses.is_dataclass(o)
            )
    return cls
