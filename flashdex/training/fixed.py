"""What cannot change in a running run: the meaning of what it has learnt so far."""

from __future__ import annotations

import dataclasses
from typing import Any

from omegaconf import OmegaConf

from flashdex.errors import RunError
from flashdex.recipe import RunRecipe

# What the records so far were made with, and what the networks and reward statistics
# of either algorithm mean.
LABELS = ("name", "ablation", "seed", "run_dir")
FIXED = (*LABELS, "algo.kind", "algo.groups", "algo.v_max")
FIXED_FLASHSAC = (
    *FIXED,
    "algo.head",
    "algo.critic_action",
    "algo.num_atoms",
    "algo.noise_clock",
)


def stored_value(text: str, key: str) -> Any:
    """Value of a recipe as it was composed, None where it has no such key.

    Args:
        text: recipe of a checkpoint, YAML.
        key: dotted path.

    Example:
        >>> stored_value("algo: {v_max: 5.0}", "algo.v_max")
        5.0
    """
    return OmegaConf.select(OmegaConf.create(text), key)


def refuse_changes(text: str, recipe: RunRecipe) -> None:
    """Refuse a recipe under which the run would be another algorithm.

    Args:
        text: recipe of the checkpoint, YAML.
        recipe: what the run is to go on with.

    Raises:
        RunError: one message with every value that differs.
    """
    stored = OmegaConf.create(text)
    present = OmegaConf.create(dataclasses.asdict(recipe))
    flashsac = OmegaConf.select(stored, "algo.kind") == "flashsac"
    changed = []
    for key in FIXED_FLASHSAC if flashsac else FIXED:
        was, now = OmegaConf.select(stored, key), OmegaConf.select(present, key)
        if was != now:
            changed.append(f"{key} from {was} to {now}")
    if changed:
        raise RunError(
            f"these cannot change in a running run: {', '.join(changed)}; start a new "
            "run"
        )
