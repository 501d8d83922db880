"""The `defaults` list of a recipe file: which groups and options it names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from flashdex.errors import nearest
from flashdex.recipe.store import search_dirs

Groups = dict[str, list[str]]


def known_groups(dirs: Sequence[Path]) -> Groups:
    """Return group name to its options, over all folders of the search path.

    Args:
        dirs: folder of the recipe first, then where names are looked up. The first
            may be any folder of the user's, so it adds options but no groups.
    """
    groups: dict[str, set[str]] = {}
    names = {path.parent.name for d in search_dirs() for path in d.glob("*/*.yaml")}
    for folder in dirs:
        for path in folder.glob("*/*.yaml"):
            if path.parent.name in names:
                groups.setdefault(path.parent.name, set()).add(path.stem)
    return {name: sorted(options) for name, options in sorted(groups.items())}


def check_option(group: str, option: str, groups: Groups, problems: list[str]) -> bool:
    """Note a group or an option that does not exist; say whether both do."""
    if group not in groups:
        problems.append(
            f"defaults.{group}: unknown group.{nearest(group, groups)} "
            f"Allowed: {', '.join(groups)}."
        )
    elif option not in groups[group]:
        problems.append(
            f"{group}={option}: there is no such {group}."
            f"{nearest(option, groups[group])} Allowed: {', '.join(groups[group])}."
        )
    else:
        return True
    return False


def check_defaults(
    path: Path, groups: Groups, problems: list[str]
) -> tuple[dict[str, list[str]], list[str]]:
    """Check the defaults list of one file.

    Args:
        path: the recipe.
        groups: what exists.
        problems: where problems are noted.

    Returns:
        The options of each group it names, and the groups with a wrong option.
    """
    named: dict[str, list[str]] = {}
    broken: list[str] = []
    has_self = False
    for entry in _read_defaults(path):
        has_self = has_self or entry == "_self_"
        for key, value in entry.items() if isinstance(entry, dict) else ():
            *words, group = str(key).replace("/", " ").split()
            _check_entry(group, words, has_self, problems)
            options = [str(v) for v in (value if isinstance(value, list) else [value])]
            good = [check_option(group, o, groups, problems) for o in options]
            named[group] = options
            if not all(good):
                broken.append(group)
    return named, broken


def _check_entry(
    group: str, words: list[str], has_self: bool, problems: list[str]
) -> None:
    """Note the two ways in which Hydra would drop a choice without a word."""
    if "optional" in words:
        problems.append(
            f"defaults.{group}: 'optional' hides a misspelt option; leave it out (use "
            f"'{group}: none' for nothing)"
        )
    if group == "ablation" and not has_self:
        problems.append(
            "defaults: '_self_' must stand before 'ablation', or the recipe wins and "
            "the ablation has no effect"
        )


def _read_defaults(path: Path) -> list[Any]:
    try:
        data = yaml.safe_load(path.read_text())
    except yaml.YAMLError:
        return []  # Hydra reads it next and says where the syntax is wrong
    entries = data.get("defaults") if isinstance(data, dict) else None
    return entries if isinstance(entries, list) else []
