"""Write docs/options.md: every option of a recipe, from the schema's own docstrings."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
import typing
from pathlib import Path
from typing import Any

from flashdex.envs.config import EnvConfig, GymConfig
from flashdex.envs.mdp.term import KINDS, registry
from flashdex.recipe import GymRecipe, LoopConfig, Recipe
from flashdex.recipe.schema import Expectation, RunRecipe
from flashdex.search.config import SearchConfig

PAGE = Path(__file__).parent / "options.md"
HEAD = """# Every option

Made by `python docs/make_options.py` from the config dataclasses and the registered
terms, the one place of defaults; a test fails when this page is not up to date. How a
recipe is put together stands on the page [recipes](recipes.md).

Metres, radians, seconds, kilograms, unless a unit is given.
"""
SEARCH_NOTE = """`flashdex search RECIPE` looks for the actions of each motion alone
([page](search.md)); of the recipe it uses `hand`, `motions`, `physics` and
`train.criterion`."""
GYM_NOTE = """With `task: gym` a recipe trains on a stock environment instead of
motions ([page](gym.md))."""
NAMED_NOTES = {
    "transforms": "Observation blocks by name. `null` takes one out of a recipe,\n"
    "`~env.transforms.NAME` does so on the command line.",
    "rewards": "Reward terms by name. A hand receives half of a weight, except of\n"
    "`failure`; every term is multiplied by the control step in seconds.",
    "terminations": "What ends an episode by failure, by name.",
}


def plain(text: str) -> str:
    """Return a docstring as one line of Markdown."""
    return " ".join(text.split()).replace("<", "&lt;")


def field_docs(cls: type) -> dict[str, str]:
    """Return what is said of each field of a dataclass, in one line each."""
    found = {f.name: plain(f.metadata.get("text", "")) for f in dataclasses.fields(cls)}
    if all(found.values()):  # the options of a term; else the docstrings below fields
        return found
    for base in cls.__bases__:
        if dataclasses.is_dataclass(base):
            found |= field_docs(base)
    tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    assert isinstance(tree, ast.ClassDef)
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        is_text = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
        if isinstance(field, ast.AnnAssign) and is_text:
            name = ast.unparse(field.target)
            found[name] = plain(str(ast.literal_eval(text.value)))
    return found


def allowed(field: dataclasses.Field[Any], hint: Any) -> str:
    """Say what a field accepts: its type or choices, and its range."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return allowed(field, args[0]) + within(args[1])
    if origin is typing.Literal:
        return ", ".join(f"`{a}`" for a in args)
    if origin is list:
        return f"list of {allowed(field, args[0])}"
    inner = [a for a in args if a is not type(None)]
    if len(inner) < len(args):
        return f"{allowed(field, inner[0])} or null"
    names = {int: "integer", float: "number", bool: "true or false", str: "text"}
    bounds = [
        f"{sign} {field.metadata[key]:g}"
        for key, sign in (("gt", "&gt;"), ("ge", "&ge;"), ("le", "&le;"))
        if field.metadata.get(key) is not None
    ]
    return " ".join([names.get(hint, str(hint)), " and ".join(bounds)]).strip()


def within(rules: Any) -> str:
    """Say what range a number of a list has; a list itself has a length."""
    pairs = [(k, getattr(r, k, None)) for r in rules.metadata for k in ("ge", "le")]
    found = {k: v for k, v in pairs if v is not None}
    return f" &ge; {found['ge']} and &le; {found['le']}" if found else ""


def default(field: dataclasses.Field[Any]) -> str:
    """Return a field's default as YAML writes it."""
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    elif field.default is dataclasses.MISSING:
        return "must be given"
    else:
        value = field.default
    if value == "":
        return "empty"
    if value is None or isinstance(value, bool):
        return f"`{str(value).lower() if value is not None else 'null'}`"
    if isinstance(value, int):
        return f"`{value:_}`"
    is_periodic = isinstance(value, float) and len(repr(value)) > 8
    return f"`1/{1 / value:.0f}`" if is_periodic else f"`{value}`"


def table(cls: type) -> list[str]:
    """Return the table of one dataclass, without what has a section of its own."""
    docs = field_docs(cls)
    hints = typing.get_type_hints(cls, include_extras=True)
    lines = ["| key | default | allowed | meaning |", "| --- | --- | --- | --- |"]
    for field in dataclasses.fields(cls):
        if not has_own_section(cls, field.name, hints[field.name]):
            cells = (default(field), allowed(field, hints[field.name]))
            lines.append(
                f"| `{field.name}` | {cells[0]} | {cells[1]} | {docs[field.name]} |"
            )
    return lines if len(lines) > 2 else ["No options."]


def has_own_section(cls: type, name: str, hint: Any) -> bool:
    """Whether a field is a group of options."""
    kinds = [hint, *typing.get_args(hint)]
    is_group = any(dataclasses.is_dataclass(kind) for kind in kinds)
    return is_group or (cls is EnvConfig and name in KINDS)


def section(path: str, cls: type, *, about: str = "") -> list[str]:
    """Return heading, description and table of one group of options, and its groups."""
    text = about or inspect.cleandoc(cls.__doc__ or "")
    intro = [plain(p) for p in text.split("\n\n") if not p.startswith("Example")]
    lines = ["## " + (path or "The recipe"), ""]
    for part in intro:
        lines += [part, ""]
    lines += [*table(cls), ""]
    hints = typing.get_type_hints(cls)
    shared = {field.name for field in dataclasses.fields(RunRecipe)}
    for name in sorted(hints, key=lambda name: name in shared):  # those come last
        hint = hints[name]
        where = f"{path}.{name}" if path else name
        for kind in (hint, *typing.get_args(hint)):
            if dataclasses.is_dataclass(kind) and kind is not Expectation:
                lines += section(where, typing.cast(type, kind))
        if cls is EnvConfig and name in KINDS:
            lines += named_section(where, name)
    return lines


def named_section(path: str, kind: str) -> list[str]:
    """Return one subsection for each registered part of a kind."""
    lines = [f"## {path}", "", NAMED_NOTES[kind], ""]
    for name, term in registry(typing.cast(Any, kind)).items():
        part = section(f"{path}.{name}", term.options, about=term.about)
        lines += ["#" + part[0], *part[1:]]
    return lines


def gym_sections() -> list[str]:
    """Return what a recipe for a stock environment has of its own."""
    loop = ", ".join(f"`{field.name}`" for field in dataclasses.fields(LoopConfig))
    note = (
        "`algo`, `logger` and `expect` are the same as above, but for the keys that "
        f"speak of hands. `train` has {loop}. The other groups do not exist there."
    )
    head = ["## The gym recipe", "", plain(GYM_NOTE), "", *table(GymRecipe), ""]
    return [*head, note, "", *section("gym", GymConfig)]


def search_sections() -> list[str]:
    """Return what a recipe of the search has besides."""
    head = ["## The search", "", plain(SEARCH_NOTE), ""]
    return [*head, *section("search", SearchConfig)]


def render() -> str:
    """Return the whole page."""
    expect = ["## expect", "", "A list; each entry promises one number.", ""]
    lines = [*section("", Recipe), *expect, *table(Expectation), ""]
    lines += [*search_sections(), *gym_sections()]
    return HEAD + "\n" + "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(render(), encoding="utf-8")
    print(f"{PAGE.name} written")
    sys.exit(0)
