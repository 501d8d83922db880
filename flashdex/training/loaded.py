"""A run opened for reading, its files verified, its policy as a TorchRL module."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, exploration_type

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.errors import FlashdexError, RunError, is_of_machine
from flashdex.motions.library import verify_library
from flashdex.motions.library_format import MANIFEST
from flashdex.recipe import Recipe, RunRecipe, expect_kind, parse_recipe
from flashdex.replay.disk import check_rows
from flashdex.rollouts.findings import Finding, faults
from flashdex.rollouts.ledger import CONVERSIONS, read_ledger
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.truth import Truth
from flashdex.rollouts.verify import Verified, verify_run
from flashdex.system.files import own_file
from flashdex.system.jsonl import read_object
from flashdex.system.run_files import (
    BASELINES,
    CHECKPOINTS,
    DUMP,
    EVALUATION,
    METRICS,
    MOTIONS,
    RECIPE,
    REPLAY,
    SESSIONS,
    SOURCE,
    VERSIONS,
    check_run,
    check_sessions,
    read_metrics,
    read_recipe,
    read_sessions,
    require_run,
    rollout_name,
    run_id,
)
from flashdex.training.baselines import check_baselines
from flashdex.training.build import RunBuilder
from flashdex.training.checkpoint import (
    check_format,
    checkpoint_files,
    read_checkpoint,
)
from flashdex.training.guard import read_dump
from flashdex.training.memory.stand_in import find_library
from flashdex.training.run_dir import load_learner, load_run_recipe
from flashdex.training.tasks.source import Source


def open_truth(run_dir: str | Path) -> tuple[Truth | None, str]:
    """Recipe and library of a run, to verify its rollouts against; see below."""
    builder, why = _open_builder(run_dir)
    return builder and _truth(builder), why


def _truth(builder: RunBuilder) -> Truth:
    return Truth(builder.recipe, builder.library, builder.hands, builder.bank)


def _open_builder(run_dir: str | Path) -> tuple[RunBuilder | None, str]:
    """What builds the parts of a run; nothing is prepared.

    Returns:
        None, and why, where the library is not at hand.
    """
    try:
        recipe = expect_kind(load_run_recipe(Path(run_dir)), Recipe, where=str(run_dir))
        if find_library(recipe) is None:
            return None, "the library that recipe.yaml names is not here"
        return RunBuilder.from_recipe(recipe, device=torch.device("cpu")), ""
    except FlashdexError as error:
        return None, str(error)


@dataclass(frozen=True)
class Verification:
    """What was read in a run or a library, and what was found.

    Attributes:
        path: the folder.
        files: that were read whole and are as flashdex wrote them.
        findings: what differs, and what could not be checked.
        why: why there was no library to check rollouts against, or empty.
    """

    path: Path
    files: list[str]
    findings: list[Finding]
    why: str = ""

    @property
    def holds(self) -> bool:
        """Nothing differs."""
        return not faults(self.findings)


def verify(path: str | Path) -> Verification:
    """Check every hash of a run or a library, and all that can be computed again.

    Nothing is trusted that was checked before, and nothing is changed.

    Raises:
        RunError: the folder is neither.
    """
    path = Path(path)
    if (path / MANIFEST).exists():
        return _verify_library(path)
    require_run(path, or_library=True)
    files, findings = read_all_files(path)
    builder, why = _open_builder(path)
    try:
        verified = verify_run(path, builder and _truth(builder))
        if builder is not None and not faults(verified.ledger):
            recipes = [era.recipe for era in verified.eras[:-1]]
            former = [recipe for recipe in recipes if isinstance(recipe, Recipe)]
            findings += check_baselines(builder, path, former)
    except RunError as error:
        if (path / CONVERSIONS).exists():
            findings.append(Finding(CONVERSIONS, "rollouts", str(error), False))
        verified = Verified([], [], [], {})
    for one in verified.rollouts:
        if one.holds:
            files.append(f"{rollout_name(one.motion)}, {one.found}")
        elif not faults(one.findings):
            text = f"is {one.found}, no proof"
            findings.append(Finding(rollout_name(one.motion), "certificate", text))
    files += [file for file, told in verified.misses.items() if not faults(told)]
    return Verification(path, files, [*findings, *verified.findings], why)


def _verify_library(path: Path) -> Verification:
    manifest, faults = verify_library(path)
    if manifest is None or faults:
        findings = [Finding(str(path), "library", fault) for fault in faults]
        return Verification(path, [], findings)
    arrays, meshes = len(manifest.arrays), len(manifest.meshes)
    files = [MANIFEST, f"{arrays} arrays", f"{meshes} meshes"]
    return Verification(path, files, [])


def read_all_files(run_dir: Path) -> tuple[list[str], list[Finding]]:
    """Read each file of a run but its rollouts; names of whole ones, and faults."""
    readers: dict[str, Callable[[], object]] = {
        "its files": partial(check_run, run_dir),
        RECIPE: partial(read_recipe, run_dir),
        METRICS: partial(read_metrics, run_dir),
        SESSIONS: partial(check_sessions, run_dir),
        DUMP: lambda: read_dump(run_dir / DUMP),
        **{
            name: partial(read_object, run_dir, name)
            for name in (BASELINES, MOTIONS, EVALUATION)
        },
        VERSIONS: partial(run_id, run_dir),
        SOURCE: partial(Source.read, run_dir),
    }
    files: list[str] = []
    findings: list[Finding] = []

    def read(name: str, reader: Callable[[], object]) -> None:
        try:
            reader()
            files.append(name)
        except (FlashdexError, ValueError) as error:
            if is_of_machine(error):
                raise
            findings.append(Finding(name, "file", str(error)))

    for name, reader in readers.items():
        if name == "its files" or (run_dir / name).exists():
            read(name, reader)
    if findings:
        return files, findings
    for path in checkpoint_files(run_dir):
        name = path.name
        read(f"{CHECKPOINTS}/{name}", partial(_check_checkpoint, run_dir, path))
        if (run_dir / REPLAY / f"{path.stem}.json").exists():
            read(f"{REPLAY}/{path.stem}", partial(check_rows, run_dir, path.stem))
    return files, findings


def _check_checkpoint(run_dir: Path, path: Path) -> None:
    state = read_checkpoint(run_dir, path.name)
    check_format(state, path, ("run", "recipe"))
    sessions = read_sessions(run_dir)
    recipes = [read_recipe(run_dir), *(line.get("before") for line in sessions)]
    known = [parse_recipe(text, where=RECIPE) for text in recipes if text]
    last = sessions[-1] if sessions else {}
    is_later = last.get("event") == "end" and state["env_steps"] > last["env_steps"]
    if (
        state["run"] != run_id(run_dir)
        or parse_recipe(state["recipe"], where=str(path)) not in known
        or is_later
    ):
        raise RunError(f"{path}: is that of another run, or of another time of it.")


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
