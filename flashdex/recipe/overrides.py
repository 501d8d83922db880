"""Overrides of the command line: Hydra's grammar, all mistakes at once."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flashdex.errors import RecipeError, nearest
from flashdex.recipe.defaults import Groups, check_option


def parse_overrides(texts: Sequence[str]) -> tuple[list[Override], list[str]]:
    """Parse each override on its own; return the good ones and the problems."""
    parser = OverridesParser.create()
    parsed: list[Override] = []
    problems: list[str] = []
    for text in texts:
        try:
            override = parser.parse_override(text)
        except HydraException:
            problems.append(
                f"override '{text}': not understood; write key=value, ~key or "
                f"group=option"
            )
            continue
        if override.is_sweep_override():
            problems.append(f"override '{text}': several values need the flag -m")
            continue
        parsed.append(override)
    return parsed, problems


def expand_sweeps(texts: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides a run: the product of all `key=a,b` (flag -m).

    Example:
        >>> expand_sweeps(["seed=0,1", "hand=xhand"])
        [['seed=0', 'hand=xhand'], ['seed=1', 'hand=xhand']]
    """
    parser = OverridesParser.create()
    choices: list[list[str]] = []
    for text in texts:
        try:
            override = parser.parse_override(text)
        except HydraException as error:
            raise RecipeError([f"override '{text}': not understood"]) from error
        if override.is_sweep_override():
            key = override.get_key_element()
            choices.append([f"{key}={v}" for v in override.sweep_string_iterator()])
        else:
            choices.append([text])
    return [list(run) for run in itertools.product(*choices)]


def choose_groups(
    parsed: Sequence[Override], groups: Groups, problems: list[str]
) -> dict[str, list[str] | None]:
    """Return the options chosen for each group; None takes the group out.

    Args:
        parsed: all overrides.
        groups: groups and their options.
        problems: where unknown options are noted; those choices are left out.
    """
    chosen: dict[str, list[str] | None] = {}
    for override in parsed:
        group = override.key_or_group
        if group not in groups:
            continue
        if override.is_delete():
            chosen[group] = None
            continue
        value = override.value()
        options = [str(v) for v in (value if isinstance(value, list) else [value])]
        # A list, so that every wrong option is noted, not only the first.
        good = [check_option(group, option, groups, problems) for option in options]
        if all(good):
            chosen[group] = options
    return chosen


def hydra_choices(
    chosen: Mapping[str, list[str] | None], named: Collection[str]
) -> list[str]:
    """Write group choices as Hydra overrides.

    Args:
        chosen: options a group; None takes the group out.
        named: groups in the recipe's own defaults list. Others are appended, which
            puts them behind `_self_`.
    """
    texts: list[str] = []
    for group, options in chosen.items():
        if options is None:
            texts += [f"~{group}"] if group in named else []
        else:
            add = "" if group in named else "+"
            value = options[0] if len(options) == 1 else f"[{','.join(options)}]"
            texts.append(f"{add}{group}={value}")
    return texts


def apply_values(
    config: DictConfig,
    parsed: Sequence[Override],
    groups: Groups,
    problems: list[str],
) -> None:
    """Apply the overrides that set or delete a value, in place."""
    for override in parsed:
        key = override.key_or_group
        if key in groups:
            continue
        try:
            if override.is_delete():
                _delete(config, key)
            else:
                OmegaConf.update(config, key, override.value(), force_add=True)
        except (OmegaConfBaseException, KeyError, TypeError, AttributeError) as error:
            detail = error.args[0] if isinstance(error, KeyError) else "no such place"
            problems.append(f"override '{override.input_line}': {detail}")


def _delete(config: DictConfig, key: str) -> None:
    parent_key, _, name = key.rpartition(".")
    parent = OmegaConf.select(config, parent_key) if parent_key else config
    known = [str(k) for k in parent] if isinstance(parent, DictConfig) else []
    if name not in known:
        allowed = f" There are: {', '.join(known)}." if known else ""
        raise KeyError(f"{key} does not exist.{nearest(name, known)}{allowed}")
    del parent[name]
