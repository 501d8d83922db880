"""A run opened for reading, and its policy as a TorchRL module."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.errors import FlashdexError, RunError
from flashdex.recipe import Recipe, RunRecipe, expect_kind
from flashdex.rollouts.ledger import CONVERSIONS, read_ledger, rollout_name
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.truth import Truth
from flashdex.system.files import own_file
from flashdex.system.run_files import read_metrics
from flashdex.training.build import RunBuilder
from flashdex.training.memory.stand_in import find_library
from flashdex.training.run_dir import load_learner, load_run_recipe


def open_truth(run_dir: str | Path) -> tuple[Truth | None, str]:
    """Recipe and library of a run, to verify its rollouts against.

    Nothing is prepared.

    Returns:
        None, and why, where the library is not at hand.
    """
    try:
        recipe = expect_kind(load_run_recipe(Path(run_dir)), Recipe, where=str(run_dir))
        if find_library(recipe) is None:
            return None, "the library that recipe.yaml names is not here"
        builder = RunBuilder.from_recipe(recipe, device=torch.device("cpu"))
    except FlashdexError as error:
        return None, str(error)
    return Truth(recipe, builder.library, builder.hands, builder.bank), ""


class RunPolicy(TensorDictModuleBase):
    """Actions of both hands from the compact state that every tracking env emits.

    It assembles what its networks read by the transforms it was trained with, so that
    transforms of the environment neither help nor disturb it. Deterministic, unless the
    exploration type is RANDOM; attempt worlds always are.

    Args:
        learner: restored from a run with motions.
    """

    def __init__(self, learner: Learner) -> None:
        super().__init__()
        self.in_keys = [*keys.STATE, keys.ATTEMPT]
        actions: list[Any] = [keys.action(side) for side in keys.SIDES]
        self.out_keys = actions
        self.learner = learner

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set ``("left", "action")`` and ``("right", "action")``, (N, J) each."""
        state = tensordict.select(*self.in_keys).to(self.learner.device)
        explore = exploration_type() == ExplorationType.RANDOM
        with torch.no_grad():
            action = self.learner.act(state, explore=explore)
        for key, value in zip(self.out_keys, action.unbind(1), strict=True):
            tensordict.set(key, value.to(tensordict.device or value.device))
        return tensordict


@dataclass(frozen=True)
class Run:
    """A run directory; nothing in it is changed.

    Attributes:
        path: the folder.
    """

    path: Path

    @cached_property
    def recipe(self) -> RunRecipe:
        """What it was trained by."""
        return load_run_recipe(self.path)

    @cached_property
    def attempts(self) -> list[dict[str, Any]]:
        """Lines of ``conversions.jsonl``, one an attempt."""
        return read_ledger(self.path / CONVERSIONS)

    @cached_property
    def metrics(self) -> list[dict[str, Any]]:
        """Records of ``metrics.jsonl``."""
        return read_metrics(self.path)

    @property
    def converted(self) -> dict[str, dict[str, Any]]:
        """Motions with a stored rollout, and the newest line that names it."""
        return {row["motion"]: row for row in self.attempts if row.get("rollout")}

    def rollout(self, motion: str) -> Rollout:
        """The stored trajectory of a motion.

        Raises:
            RunError: there is none; the message names those there are.
        """
        if motion not in self.converted:
            known = ", ".join(self.converted) or "none"
            raise RunError(f"{self.path}: no rollout of '{motion}'. Stored: {known}.")
        return Rollout.load(own_file(self.path, rollout_name(motion)))

    def policy(self) -> RunPolicy:
        """The newest policy."""
        expect_kind(self.recipe, Recipe, where=str(self.path))
        return RunPolicy(load_learner(self.path)[1])
