"""YAML as recipes may be written: plain values of a limited size, from a regular file.

A recipe may come from anybody. What is read here never imports, never expands and never
waits: tags are refused, aliases and depth are counted before anything is built, and a
pipe or a device is no file.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from flashdex.errors import RecipeError

MAX_BYTES = 2**20
MAX_DEPTH = 24
MAX_VALUES = 50_000
MAX_PLAIN = 4096  # letters without quotes: of a number, each costs more than the last
MAX_INT = 2**64
_PLAIN = (dict, list, str, int, float, bool, type(None))


_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # C is ten times faster


class _Loader(_Base):
    """Safe loading of keys and values: no key twice, no date, no merged mapping."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _fault(key, "'<<' merges mappings, which recipes do not")
            if key.tag != "tag:yaml.org,2002:str":
                raise _fault(key, "a key is a word, in quotes where it is none")
            if key.value in seen:
                raise _fault(key, f"the key {key.value!r} stands twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def _fault(node: Any, text: str) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(problem=text, problem_mark=node.start_mark)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, rule) for tag, rule in rules if not tag.endswith(":timestamp")]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
# YAML 1.1 takes 1e-3 for a word; people mean a number
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(path: Path) -> dict[str, Any]:
    """Keys and values of a recipe file; an empty file has none.

    Raises:
        RecipeError: one line that says why it is no recipe, and where.
    """
    return parse_yaml(read_text(path), where=str(path))


def parse_yaml(text: str, *, where: str) -> dict[str, Any]:
    """Keys and values of a text; see ``read_yaml``."""
    try:
        _measure(text)
        data = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise RecipeError([_explain(error)], where=where) from error
    except (RecursionError, ValueError, OverflowError) as error:
        raise RecipeError([f"cannot be read: {error}"], where=where) from error
    if not isinstance(data, dict | None):
        kind = "a list" if isinstance(data, list) else f"'{str(data)[:60]}'"
        raise RecipeError([f"expected keys and values, found {kind}"], where=where)
    _check_values(data, where)
    return data or {}


def read_text(path: Path) -> str:
    """The text of a small regular file in UTF-8.

    Raises:
        RecipeError: it is none.
    """
    try:
        # a pipe would be waited for without O_NONBLOCK
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            facts = os.fstat(file.fileno())
            if not stat.S_ISREG(facts.st_mode):
                raise RecipeError(["not a regular file"], where=str(path))
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecipeError([f"cannot be read: {reason}"], where=str(path)) from error
    if len(content) > MAX_BYTES:
        problem = f"larger than {MAX_BYTES // 1024} KiB, which no recipe is"
        raise RecipeError([problem], where=str(path))
    try:
        return content.decode("utf-8-sig")  # a mark of byte order is let pass
    except UnicodeDecodeError as error:
        problem = f"not UTF-8 text (byte {error.start}); save it in that encoding"
        raise RecipeError([problem], where=str(path)) from error


def _measure(text: str) -> None:
    """Refuse what is deep or many, before it is built."""
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=_Loader)):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if (
            isinstance(event, yaml.ScalarEvent)
            and event.style in (None, "")
            and len(event.value) > MAX_PLAIN
        ):
            raise _fault(event, f"over {MAX_PLAIN} letters without quotes")
        if depth > MAX_DEPTH:
            raise _fault(event, f"nested more than {MAX_DEPTH} levels deep")
        if count > 2 * MAX_VALUES:
            raise _fault(event, f"more than {MAX_VALUES} values")


def _check_values(data: Any, where: str) -> None:
    """Refuse dates, sets and bytes, and aliases that unfold to many values."""
    for count, (value, depth) in enumerate(_walk(data, 0)):
        if not isinstance(value, _PLAIN):
            kind = type(value).__name__
            raise RecipeError([f"a value of type {kind} is not allowed"], where=where)
        if isinstance(value, int) and abs(value) > MAX_INT:  # no float, and no text
            raise RecipeError(["a number of more than 64 bits"], where=where)
        if count > MAX_VALUES or depth > MAX_DEPTH:
            problem = f"unfolds to more than {MAX_VALUES} values or {MAX_DEPTH} levels"
            raise RecipeError([problem], where=where)


def _walk(value: Any, depth: int) -> Iterator[tuple[Any, int]]:
    yield value, depth
    inner = value.values() if isinstance(value, dict) else value
    for part in inner if isinstance(inner, list | type({}.values())) else ():
        yield from _walk(part, depth + 1)


def _explain(error: yaml.YAMLError) -> str:
    """What is wrong with the syntax and where, in one line."""
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or " ".join(str(error).split())
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{place}{problem[:200]}"
