"""Changes of a recipe as the command line writes them, in Hydra's grammar.

`key.path=value` sets, `~key.path` removes, `group=option` chooses; a value that the
grammar cannot read is taken as the text that it is, so that a path is a path.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from flashdex.errors import RecipeError, nearest
from flashdex.recipe.store import find_recipe, known_groups

PATHS = ("run_dir", *(f"motions.{k}" for k in ("library", "input", "mano", "models")))
"""Keys whose value is a path, whatever is in it."""
MAX_RUNS = 1000
_MAX_LENGTH = 100_000
_LITERAL = re.compile(r"\+{0,2}([A-Za-z_][\w.]*)=(.*)", re.DOTALL)
_FILLED = re.compile(r"\$\{([\w.]+)\}")


@dataclass(frozen=True)
class Change:
    """One override."""

    text: str  # as it was written
    key: str  # path of a value, or a group
    value: Any = None
    is_delete: bool = False

    @property
    def options(self) -> list[str] | None:
        """What it chooses where its key is a group; None takes the group out."""
        return None if self.is_delete else as_options(self.value)


def as_options(value: Any) -> list[str] | None:
    """The options that a value names: none, one, or several."""
    if value is None:
        return None
    return [str(option) for option in (value if isinstance(value, list) else [value])]


def parse_overrides(texts: Sequence[str]) -> tuple[list[Change], list[str]]:
    """Parse each override on its own; return the good ones and the problems."""
    parsed: list[Change] = []
    problems: list[str] = []
    for text in texts:
        found = _parse(text)
        if isinstance(found, str):
            problems.append(f"override '{_short(text)}': {found}")
        else:
            parsed.append(found)
    return parsed, problems


def _parse(text: str) -> Change | str:
    """An override, or what is wrong with it."""
    if len(text) > _MAX_LENGTH or not text.isprintable():
        return "longer than any value, or with characters that cannot be shown"
    literal = _LITERAL.fullmatch(text)
    found = _understand(text)
    if literal and (found is None or _is_misread(literal[1], found)):
        return Change(text, literal[1], literal[2])
    if found is None:
        return "not understood; write key=value, ~key or group=option"
    if found.is_sweep_override():
        return "several values need the flag -m; a text is quoted: key='\"a,b\"'"

    if not found.key_or_group or found.package is not None:
        return "not understood; write key=value, ~key or group=option"
    value = None if found.is_delete() else found.value()
    return Change(text, found.key_or_group, value, found.is_delete())


def _understand(text: str) -> Override | None:
    """What Hydra's grammar makes of an override; None where it cannot read it."""
    try:
        return OverridesParser.create().parse_override(text)
    except (HydraException, ValueError, RecursionError, OverflowError):
        return None


def _is_misread(key: str, found: Override) -> bool:
    """Whether a path was taken for a number, a list or several values."""
    if key not in PATHS or found.is_delete():
        return False
    return found.is_sweep_override() or not isinstance(found.value(), str | None)


def expand_sweeps(texts: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides a run: the product of all `key=a,b` (flag -m).

    Raises:
        RecipeError: an override that is not understood, an interval, or too many runs.

    Example:
        >>> expand_sweeps(["seed=0,1", "hand=xhand"])
        [['seed=0', 'hand=xhand'], ['seed=1', 'hand=xhand']]
    """
    choices = [_choices(text) for text in texts]
    runs = list(itertools.islice(itertools.product(*choices), MAX_RUNS + 1))
    if len(runs) > MAX_RUNS:
        raise RecipeError([f"-m asks for more than {MAX_RUNS} runs"])
    return [list(run) for run in runs]


def _choices(text: str) -> list[str]:
    found = _understand(text)
    if found is None or not found.is_sweep_override():
        if found is None and "," in text:
            problem = 'not understood; quote each value: key=\'"a","b"\''
            raise RecipeError([f"override '{_short(text)}': {problem}"])
        return [text]
    try:
        values = list(itertools.islice(found.sweep_string_iterator(), MAX_RUNS + 1))
    except HydraException as error:  # an interval or a glob has no list of values
        problem = "give the values one by one, key=a,b, or as key=range(1,4)"
        raise RecipeError([f"override '{_short(text)}': {problem}"]) from error
    return [f"{found.get_key_element()}={value}" for value in values]


def check_words(name: str | Path, runs: Sequence[Sequence[str]]) -> None:
    """Refuse what the words alone show, before the schema, with torch, is loaded.

    Args:
        name: of a recipe, or its path.
        runs: overrides of each run.

    Raises:
        FlashdexError: there is no such recipe or option, or a word is not understood.
    """
    groups = known_groups(find_recipe(name).parent)
    problems: dict[str, None] = {}  # runs of a grid share most of their words
    for texts in runs:
        changes, found = parse_overrides(texts)
        chosen = [c for c in changes if c.key in groups]
        found += [p for c in chosen for p in choice_problems(groups, c.key, c.options)]
        problems |= dict.fromkeys(found)
    if problems:
        raise RecipeError(list(problems), where=f"recipe {name}")


def choice_problems(
    groups: Mapping[str, Sequence[str]], group: str, options: Sequence[str] | None
) -> list[str]:
    """Say that a group or an option does not exist.

    Args:
        groups: options of each group.
        group: that was chosen from.
        options: that were chosen.
    """
    known = groups.get(group)
    if known is None:
        return [
            f"defaults.{group}: unknown group.{nearest(group, groups)} "
            f"Allowed: {', '.join(groups)}."
        ]
    return [
        f"{group}={option}: there is no such {group}."
        f"{nearest(option, known)} Allowed: {', '.join(known)}."
        for option in options or ()
        if option not in known
    ]


def merge(below: Any, above: Any) -> Any:
    """A copy of ``below`` with what ``above`` says; mappings are merged, lists not."""
    if isinstance(above, Mapping):
        mine = below if isinstance(below, Mapping) else {}
        kept = {key: merge(None, mine[key]) for key in mine if key not in above}
        both = {key: merge(mine.get(key), value) for key, value in above.items()}
        merged = kept | both
        return {key: merged[key] for key in (*mine, *both)}
    return [merge(None, item) for item in above] if isinstance(above, list) else above


def apply_changes(
    data: dict[str, Any], changes: Sequence[Change], problems: list[str]
) -> None:
    """Set and remove values, in place; what cannot be is noted."""
    for change in changes:
        try:
            _apply(data, change)
        except (LookupError, ValueError) as error:
            problems.append(f"override '{_short(change.text)}': {error.args[0]}")


def _apply(data: dict[str, Any], change: Change) -> None:
    *way, last = change.key.split(".")
    place: Any = data
    for i, key in enumerate(way):
        if isinstance(place, dict) and place.get(key) is None and not change.is_delete:
            place[key] = {}
        place = _enter(place, key, ".".join(way[: i + 1]))
    if change.is_delete:
        _enter(place, last, change.key)
        del place[_index(place, last)]
    elif isinstance(place, dict):
        place[last] = merge(place.get(last), change.value)
    else:
        _enter(place, last, change.key)
        place[_index(place, last)] = change.value


def _index(place: Any, key: str) -> Any:
    return int(key) if isinstance(place, list) else key


def _enter(place: Any, key: str, path: str) -> Any:
    """What is found under a key of a mapping or at a place of a list."""
    known = [str(k) for k in place] if isinstance(place, dict) else []
    if isinstance(place, list):
        known = [str(i) for i in range(len(place))]
    if key not in known:
        allowed = f" There are: {', '.join(known)}." if known else ""
        raise LookupError(f"{path} does not exist.{nearest(key, known)}{allowed}")
    return place[_index(place, key)]


def expand_home(data: dict[str, Any]) -> None:
    """Put the home folder for a leading `~/` of a path, in place, as a shell would."""
    for key in PATHS:
        *way, last = key.split(".")
        place = _look_up(data, ".".join(way)) if way else data
        path = place.get(last) if isinstance(place, dict) else None
        if isinstance(path, str) and path.startswith("~/"):
            place[last] = os.path.expanduser(path)


def fill_in(data: dict[str, Any], problems: list[str]) -> None:
    """Put plain values for `${key.path}`, in place; all else in `${}` is refused.

    Resolvers are refused: `${oc.env:NAME}` would write a secret of the machine that
    composes a recipe into the recipe of the run.
    """
    for place, key, path in list(_texts(data, "")):
        text = place[key]
        filled = _FILLED.sub(lambda found: _plain(data, found), text)
        if "${" in filled:
            problems.append(
                f"{path}: {_short(text)!r} is not filled in; in a recipe ${{key.path}} "
                "stands for a plain value of the same recipe, and for nothing else"
            )
        elif found := _FILLED.fullmatch(text):
            place[key] = _look_up(data, found[1])
        else:
            place[key] = filled


def _plain(data: Any, found: re.Match[str]) -> str:
    value = _look_up(data, found[1])
    is_plain = isinstance(value, str | int | float) and "${" not in str(value)
    return str(value) if is_plain else found[0]


def _look_up(data: Any, path: str) -> Any:
    for key in path.split("."):
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _texts(place: Any, path: str) -> Iterator[tuple[Any, Any, str]]:
    """Every text with `${`: where it stands, under which key, and its YAML path."""
    pairs = place.items() if isinstance(place, dict) else enumerate(place)
    for key, value in pairs:
        where = f"{path}.{key}" if isinstance(place, dict) else f"{path}[{key}]"
        if isinstance(value, dict | list):
            yield from _texts(value, where)
        elif isinstance(value, str) and "${" in value:
            yield place, key, where.removeprefix(".")


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:100]}...{text[-10:]}"
