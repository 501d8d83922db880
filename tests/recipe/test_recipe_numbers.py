"""Every number of every recipe: bounded on both sides, and refused by name beyond."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from flashdex.algorithms import known_algorithms
from flashdex.envs.mdp.term import KINDS, registry
from flashdex.recipe import GymRecipe, Recipe, compose
from flashdex.recipe.check import read_recipe
from flashdex.system.fields import number

BAD = {
    "nan": math.nan,
    "inf": math.inf,
    "minus_inf": -math.inf,
    "1e20": 10**20,
    "1e18": 10**18,
    "minus_1": -1,
    "minus_1e18": -1e18,
    "text": "text",
    "number_as_text": "1",
    "null": None,
    "list": [],
    "mapping": {"a": 1},
    "true": True,
}
BASE = {Recipe: "quickstart", GymRecipe: "gym_halfcheetah"}
# a promise is an entry of a list: the first one of the base recipe
IN_LISTS = {"expect": "expect.0"}


def numbers_of(cls: type, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield path, field and type of every number of a dataclass and its parts."""
    hints = get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        where = f"{path}.{field.name}".removeprefix(".")
        parts = [p for p in flatten(hints[field.name]) if isinstance(p, type)]
        for part in [p for p in parts if dataclasses.is_dataclass(p)]:
            yield from numbers_of(part, IN_LISTS.get(where, where))
        if {int, float} & set(parts):
            yield where, field, hints[field.name]


def flatten(hint: Any) -> list[Any]:
    if get_origin(hint) is None:
        return [hint]
    inner = [a for a in get_args(hint) if isinstance(a, type) or get_origin(a)]
    return [part for arg in inner for part in flatten(arg)] + list(
        getattr(hint, "__metadata__", ())
    )


def all_numbers() -> list[Any]:
    found = []
    for root, name in BASE.items():
        for path, field, hint in numbers_of(root):
            found.append(pytest.param(name, path, field, hint, id=f"{name}:{path}"))
    for kind in KINDS:
        for term in registry(kind).values():
            for path, field, hint in numbers_of(term.options):
                where = f"env.{kind}.{term.name}.{path}"
                found.append(
                    pytest.param("quickstart", where, field, hint, id=f"term:{where}")
                )
    return found


NUMBERS = all_numbers()


def bounds(field: Any, hint: Any) -> tuple[float, float]:
    """Least and largest value, both finite or the test fails."""
    ranges: dict[str, float] = dict(field.metadata)
    for part in flatten(hint):
        for rule in getattr(part, "metadata", ()):
            for key in ("ge", "gt", "le"):
                if getattr(rule, key, None) is not None:
                    ranges[key] = getattr(rule, key)
    low = ranges.get("ge", ranges.get("gt", -math.inf))
    return low, ranges.get("le", math.inf)


@pytest.mark.parametrize(("name", "path", "field", "hint"), NUMBERS)
def test_every_number_has_two_finite_bounds(name, path, field, hint):
    low, high = bounds(field, hint)
    assert -1e16 < low < high < 1e16


@pytest.mark.parametrize(("name", "path", "field", "hint"), NUMBERS)
def test_a_number_beyond_its_bounds_is_refused_by_name(name, path, field, hint):
    low, high = bounds(field, hint)
    tried = {**BAD, "below": low - 1, "above": high * 2 + 1}
    is_list = "list[" in str(hint)
    for what, value in tried.items():
        is_number = type(value) in (int, float)
        is_allowed = (is_number and low <= value <= high) or (
            value is None and type(None) in flatten(hint)
        )
        whole = [value] * 3 if is_list and is_number else value
        found = problems_with(name, path, whole)
        named = [p for p in found if p.startswith(spelt(path))]
        assert bool(named) or is_allowed, f"{path}={what} passes"


def test_algorithms_of_flashdex_add_no_other_numbers():
    """One that has a schema of its own is walked as well."""
    for learner in known_algorithms().values():
        assert [*numbers_of(learner.config_class)]


def spelt(path: str) -> str:
    """A path as messages write it."""
    return path.replace("expect.0", "expect[0]")


@functools.cache
def composed(name: str) -> dict[str, Any]:
    return dataclasses.asdict(compose(name))


def problems_with(name: str, path: str, value: Any) -> list[str]:
    """What is wrong with a shipped recipe once one value of it is another."""
    data = copy.deepcopy(composed(name))
    *way, last = path.split(".")
    place: Any = data
    for key in way:
        if isinstance(place, dict) and place[key] is None:
            place[key] = {}
        place = place[int(key) if isinstance(place, list) else key]
    place[last] = value
    return read_recipe(data)[1]


@pytest.mark.parametrize(
    "ends",
    [{}, {"high": 1}, {"low": 0}, {"low": 0, "above": 0, "high": 1}],
    ids=["none", "no_low", "no_high", "two_low"],
)
def test_a_number_cannot_be_declared_without_two_ends(ends):
    with pytest.raises(TypeError):
        number(1.0, **ends)
