"""From a recipe's name and overrides to a checked recipe.

A file names the groups that it is merged with in its list ``defaults``, as Hydra's do;
values and names are then checked against the dataclasses.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from flashdex.errors import FlashdexError, RecipeError
from flashdex.recipe.check import read_recipe
from flashdex.recipe.overrides import (
    Change,
    apply_changes,
    as_options,
    choice_problems,
    expand_home,
    expand_sweeps,
    fill_in,
    merge,
    parse_overrides,
)
from flashdex.recipe.reader import parse_yaml, read_text
from flashdex.recipe.schema import Recipe, RunRecipe
from flashdex.recipe.store import (
    find_recipe,
    group_of,
    known_groups,
    recipe_files,
    search_dirs,
)
from flashdex.recipe.tasks import kind_of, mark_keys

Options = dict[str, list[str] | None]
"""Options chosen for each group; None takes the group out."""
MAX_FILES = 64
_PACKAGE = re.compile(r"^#\s*@package\s+(\S+)", re.MULTILINE)


class _Composer:
    """Merges a recipe with the files that it names, and notes what is wrong."""

    def __init__(self, folder: Path, problems: list[str]) -> None:
        self.dirs = [folder, *(d for d in search_dirs() if d != folder)]
        self.groups = known_groups(folder)
        self.problems = problems
        self.chosen: Options = {}  # stronger than what a file says
        self.used: Options = {}
        self.keys: set[str] = set()  # at the top of a recipe, that options write to
        self._open: list[Path] = []
        self._count = 0

    def choose(self, changes: Sequence[Change]) -> list[Change]:
        """Take the choices of options out of the changes; return the others."""
        others = []
        for change in changes:
            if change.key not in self.groups:
                others.append(change)
                continue
            found = choice_problems(self.groups, change.key, change.options)
            self.problems += found
            if not found:
                self.chosen[change.key] = change.options
        return others

    def compose(self, path: Path) -> dict[str, Any]:
        """The recipe merged with everything that it and the command line name."""
        data = self._load(path, None)
        for group in [g for g in self.chosen if g not in self.used]:
            data = merge(data, self._group(group, []))
        return data

    def load_option(self, path: Path, group: str) -> dict[str, Any]:
        """The file of an option alone, with what it names."""
        return self._load(path, group)

    def _load(self, path: Path, group: str | None) -> dict[str, Any]:
        """One file, with what its list of defaults names before and after it."""
        where = f"{group}/{path.stem}" if group else path.name
        self._count += 1
        if path in self._open or self._count > MAX_FILES:
            way = " -> ".join(p.stem for p in [*self._open, path][-5:])
            self.problems.append(f"{where}: includes itself, or too many files ({way})")
            return {}
        self._open.append(path)
        try:
            return self._merge(where, read_text(path), group)
        except RecipeError as error:
            self.problems += [f"{where}: {problem}" for problem in error.problems]
            return {}
        finally:
            self._open.pop()

    def _merge(self, where: str, text: str, group: str | None) -> dict[str, Any]:
        body = parse_yaml(text, where=where)
        entries = body.pop("defaults", None) or []
        if not isinstance(entries, list):
            self.problems.append(f"{where}: defaults: expected a list")
            entries = []
        own = self._packaged(where, text, body, group) if group else body
        self._note_overrides(entries)
        merged: dict[str, Any] = {}
        for i, entry in enumerate(entries):
            before = entries[:i]
            merged = merge(merged, own if entry == "_self_" else {})
            merged = merge(merged, self._entry(where, entry, before, group))
        return merged if "_self_" in entries else merge(merged, own)

    def _packaged(
        self, where: str, text: str, body: dict[str, Any], group: str
    ) -> dict[str, Any]:
        """The values of an option, under the key that it or its group is for."""
        found = _PACKAGE.search(text)
        package = found[1] if found else group
        if package not in ("_global_", *self.groups):
            self.problems.append(
                f"{where}: '@package {package}' is not known; _global_ puts the "
                "values at the top, the name of another group under that one's key, "
                "without the line they belong to the group itself"
            )
        self.keys.add(group if package == "_global_" else package)
        return body if package == "_global_" else {package: body}

    def _note_overrides(self, entries: list[Any]) -> None:
        """`override group: option` replaces what the files named before choose."""
        for entry in entries:
            for key, value in entry.items() if isinstance(entry, dict) else ():
                words = str(key).replace("/", " ").split()
                if words[:-1] == ["override"]:
                    self.chosen.setdefault(words[-1], as_options(value))

    def _entry(
        self, where: str, entry: Any, before: list[Any], group: str | None
    ) -> dict[str, Any]:
        """What one line of a list of defaults adds."""
        if entry == "_self_":
            return {}
        if isinstance(entry, str):
            return self._file(entry) if group is None else self._group(group, [entry])
        if not isinstance(entry, dict) or len(entry) != 1:
            self.problems.append(f"{where}: defaults: '{entry}' is no 'group: option'")
            return {}
        ((key, value),) = entry.items()
        *words, name = str(key).replace("/", " ").split() or [""]
        self._check_words(name, words, "_self_" in before)
        if words == ["override"] and name in self.used:
            return {}  # the file that names the group has it already
        return self._group(name, as_options(value))

    def _check_words(self, group: str, words: list[str], has_self: bool) -> None:
        """Note the ways in which a choice would be dropped without a word."""
        if "optional" in words:
            self.problems.append(
                f"defaults.{group}: 'optional' hides a misspelt option; leave it out "
                f"(use '{group}: none' for nothing)"
            )
        if group == "ablation" and not has_self:
            self.problems.append(
                "defaults: '_self_' must stand before 'ablation', or the recipe wins "
                "and the ablation has no effect"
            )

    def _file(self, name: str) -> dict[str, Any]:
        """Another recipe that one is built on."""
        for folder in self.dirs if "/" not in name else ():
            if (folder / f"{name}.yaml").is_file():
                return self._load(folder / f"{name}.yaml", None)
        self.problems.append(f"defaults: there is no recipe '{name}' to build on")
        return {}

    def _group(self, group: str, named: list[str] | None) -> dict[str, Any]:
        """The options of a group that are chosen, or else named."""
        options = self.chosen.get(group, named)
        self.used[group] = options
        self.problems += choice_problems(self.groups, group, options)
        merged: dict[str, Any] = {}
        for option in options or ():
            if option in self.groups.get(group, ()):
                merged = merge(merged, self._load(self._find(group, option), group))
        return merged

    def _find(self, group: str, option: str) -> Path:
        paths = [folder / group / f"{option}.yaml" for folder in self.dirs]
        return next(path for path in paths if path.is_file())


def compose(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> RunRecipe:
    """Compose a recipe; every mistake in it is reported at once.

    Args:
        name_or_path: a name that `flashdex ls` lists, or a YAML file.
        overrides: Hydra overrides: `seed=1`, `ablation=no_future`,
            `~env.transforms.contact`.

    Raises:
        RecipeError: with all problems, each with its YAML path.

    Example:
        >>> compose("quickstart", ["seed=8"]).seed
        8
    """
    recipe, problems = inspect_recipe(name_or_path, overrides)
    if problems:
        raise RecipeError(problems, where=f"recipe {name_or_path}")
    return recipe


def compose_runs(name_or_path: str | Path, overrides: Sequence[str]) -> list[RunRecipe]:
    """Compose one recipe for each combination of `key=a,b` (flag -m).

    Each run gets a numbered folder inside `run_dir`, or inside runs/<name>-grid.
    """
    recipes = [compose(name_or_path, run) for run in expand_sweeps(overrides)]
    return [
        dataclasses.replace(r, run_dir=f"{r.run_dir or f'runs/{r.name}-grid'}/{i}")
        for i, r in enumerate(recipes)
    ]


def inspect_recipe(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> tuple[RunRecipe, list[str]]:
    """The recipe (unusable with problems) and the problems.

    Raises:
        FlashdexError: there is no such file, or it cannot be read.
    """
    path = find_recipe(name_or_path)
    parse_yaml(read_text(path), where=path.name)  # what else could be said is not true
    changes, problems = parse_overrides(overrides)
    composer = _Composer(path.parent, problems)
    changes = composer.choose(changes)
    # a file may be called by bytes that are no text
    stem = path.stem.encode("utf-8", "replace").decode()
    data = merge({"name": stem}, composer.compose(path))
    used = {group: options for group, options in composer.used.items() if options}
    if "ablation" in used:
        data["ablation"] = "+".join(used["ablation"] or ())
    return _read(data, changes, problems, keys=composer.keys)


def inspect_option(path: Path, group: str) -> list[str]:
    """The problems of an option of a group, on a recipe with nothing else in it."""
    problems: list[str] = []
    least = {"name": path.stem, "total_env_steps": 10**9}
    data = merge(least, _Composer(path.parent, problems).load_option(path, group))
    if kind_of(data).root is Recipe and not data.get("motions"):
        data["motions"] = {"source": "procedural"}
    return _read(data, [], problems)[1]


def _read(
    data: dict[str, Any],
    changes: Sequence[Change],
    problems: list[str],
    keys: Iterable[str] = (),
) -> tuple[RunRecipe, list[str]]:
    """Apply changes to composed values and check the whole."""
    data = merge(kind_of(data).make_base(), data)
    apply_changes(data, changes, problems)
    fill_in(data, problems)
    expand_home(data)
    recipe, found = read_recipe(mark_keys(data, keys))
    return recipe, problems + found


def load_recipe(path: str | Path, overrides: Sequence[str] = ()) -> RunRecipe:
    """Read a complete recipe, as `dump_recipe` wrote it, without composing.

    Args:
        path: the file, `recipe.yaml` of a run for example.
        overrides: values to change (`key=value`); groups cannot be chosen any more.
    """
    if not Path(path).exists():
        raise FlashdexError(f"{path}: there is no such recipe file")
    return parse_recipe(read_text(Path(path)), overrides, where=str(path))


def parse_recipe(text: str, overrides: Sequence[str] = (), *, where: str) -> RunRecipe:
    """Read the text of a complete recipe; see ``load_recipe``."""
    return _change(parse_yaml(text, where=where), overrides, where=where)


def dump_recipe(recipe: RunRecipe, path: str | Path | None = None) -> str:
    """Return the complete recipe as YAML, and write it when a path is given."""
    text = OmegaConf.to_yaml(OmegaConf.create(dataclasses.asdict(recipe)))
    if path is not None:
        Path(path).write_text(text, encoding="utf-8")
    return text


def override_recipe(recipe: RunRecipe, overrides: Sequence[str]) -> RunRecipe:
    """Change values of a composed recipe."""
    data = dataclasses.asdict(recipe)
    return _change(data, overrides, where=f"recipe {recipe.name}")


def _change(data: dict[str, Any], overrides: Sequence[str], *, where: str) -> RunRecipe:
    changes, problems = parse_overrides(overrides)
    apply_changes(data, changes, problems)
    fill_in(data, problems)
    expand_home(data)
    recipe, found = read_recipe(data)
    if problems + found:
        raise RecipeError(problems + found, where=where)
    return recipe


def validate_paths(paths: Sequence[str | Path]) -> list[Path]:
    """Compose every recipe; all problems of all files are raised together.

    Args:
        paths: recipes or options of groups, their names, files or folders (the YAML
            files at their top level).

    Returns:
        The files that were checked.
    """
    files = [file for path in paths for file in recipe_files(path)]
    problems = []
    for file in files:
        problems += [f"{file}: {problem}" for problem in _problems_of(file)]
    if problems:
        raise RecipeError(problems, where=f"{len(files)} recipes checked")
    return files


def _problems_of(file: Path) -> list[str]:
    try:
        group = group_of(file)
        return inspect_option(file, group) if group else inspect_recipe(file)[1]
    except RecipeError as error:
        return error.problems
