"""Run directories: start a training run, resume it, write what it leaves behind."""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.recipe import (
    Recipe,
    RunRecipe,
    dump_recipe,
    expect_kind,
    load_recipe,
)
from flashdex.replay.buffer import check_pinning
from flashdex.system.allocator import keep_freed_memory
from flashdex.system.files import run_lock, write_atomic
from flashdex.system.machine import versions
from flashdex.training.assemble import RECIPE, make_trainer
from flashdex.training.build import Workbench, learner_device, open_workbench
from flashdex.training.checkpoint import (
    RESUMED,
    has_checkpoint,
    load_checkpoint,
    remove_temporaries,
    set_aside_newer,
)
from flashdex.training.memory import check_memory
from flashdex.training.session import end_session, refuse_changes
from flashdex.training.stand_in import find_library

_LOG = logging.getLogger(__name__)
VERSIONS = "versions.json"


def default_run_dir(recipe: RunRecipe) -> Path:
    """Folder of a run: the recipe's, or one named after recipe, ablation and seed."""
    if recipe.run_dir is not None:
        return Path(recipe.run_dir)
    return Path("runs") / f"{recipe.name}-{recipe.ablation}-s{recipe.seed}"


def train(recipe: Recipe) -> Path:
    """Train a recipe from the beginning; return its run directory.

    Args:
        recipe: validated recipe.

    Raises:
        RunError: the folder already holds a run.
    """
    run_dir = default_run_dir(recipe)
    refuse_old_run(run_dir)  # at once, before motions are prepared
    device = learner_device(recipe)
    if recipe.algo.replay == "pinned":
        check_pinning(device)
    if find_library(recipe) is None:
        check_memory(recipe, run_dir=run_dir)  # before what may be hours
    bench = open_workbench(recipe)
    _LOG.info("%s", check_memory(recipe, library=bench.library, run_dir=run_dir))
    with new_run(run_dir, recipe):
        return _train(bench, run_dir, None, [])


def resume(run: str | Path, overrides: list[str] | None = None) -> Path:
    """Continue a run from its newest checkpoint, or from the start without one.

    Args:
        run: run directory.
        overrides: ``key=value`` changes to the stored recipe.

    Raises:
        RunError: another process trains there, or the checkpoint does not fit the
            overrides; the run is as it was then.
    """
    run_dir, overrides = Path(run), overrides or []
    recipe = load_run_recipe(run_dir, overrides)
    with run_lock(run_dir):
        remove_temporaries(run_dir)
        state = None
        if has_checkpoint(run_dir):
            state = load_checkpoint(run_dir, RESUMED)
            refuse_changes(state["recipe"], recipe)
        bench = open_workbench(recipe)
        _LOG.info("%s", check_memory(recipe, library=bench.library, run_dir=run_dir))
        # Nothing of the run is touched before all that could refuse it.
        if state is not None:
            set_aside_newer(run_dir, state["env_steps"])
        else:
            _LOG.warning("%s: stopped before its first checkpoint, from 0", run_dir)
        return _train(bench, run_dir, state, overrides)


def load_run_recipe(run_dir: Path, overrides: list[str] | None = None) -> Recipe:
    """Read the recipe a run was started with."""
    path = run_dir / RECIPE
    if not path.is_file():
        raise RunError(f"{run_dir}: not a run directory, there is no {RECIPE} in it.")
    return expect_kind(load_recipe(path, overrides or []), Recipe, where=str(run_dir))


@contextlib.contextmanager
def new_run(run_dir: Path, recipe: RunRecipe) -> Iterator[None]:
    """Make the folder of a new run and hold it; nobody else may start one in it.

    Args:
        run_dir: its folder, existing or not.
        recipe: what it will train.

    Raises:
        RunError: it holds a run, another process is at it, or it cannot be written.
    """
    with contextlib.ExitStack() as held:
        with _reported(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
            held.enter_context(run_lock(run_dir))
        refuse_old_run(run_dir)  # another process may have just ended one
        create_run_dir(run_dir, recipe)
        yield


def refuse_old_run(run_dir: Path) -> None:
    """Raise a RunError when the folder already holds a run."""
    if (run_dir / RECIPE).exists():
        raise RunError(
            f"{run_dir}: already holds a run. Continue it with 'flashdex train "
            f"--resume {run_dir}', or choose another folder with run_dir=..."
        )


def create_run_dir(run_dir: Path, recipe: RunRecipe) -> None:
    """Make the folder with recipe, versions and the state of the source tree."""
    with _reported(run_dir):
        run_dir.mkdir(parents=True, exist_ok=True)
        write_atomic(run_dir / VERSIONS, json.dumps(versions(), indent=1))
        diff = _git("diff", "HEAD")
        if diff:
            write_atomic(run_dir / "git.diff", diff)
        write_atomic(run_dir / RECIPE, dump_recipe(recipe))


@contextlib.contextmanager
def _reported(run_dir: Path) -> Iterator[None]:
    """A folder that cannot be written is a mistake of the user."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{run_dir}: cannot be written ({error.strerror}). Choose another folder "
            "with run_dir=..."
        ) from error


def _git(*args: str) -> str:
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *args],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _train(
    bench: Workbench,
    run_dir: Path,
    state: dict[str, Any] | None,
    overrides: list[str],
) -> Path:
    """Train from a checkpoint, or from the beginning when there is none."""
    recipe = bench.recipe
    torch.manual_seed(recipe.seed)
    keep_freed_memory()
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)
    trainer = make_trainer(bench, run_dir, state, overrides)
    why = "error"
    try:
        why = trainer.run()
    finally:
        trainer.scorer.close(wait=why != "error")
        trainer.log.close()
        with contextlib.suppress(OSError):  # the disk may be what ended it
            end_session(
                run_dir, why, env_steps=trainer.env_steps, wall_s=trainer.wall_s
            )
    _LOG.info("ended after %d env steps: %s", trainer.env_steps, why)
    return run_dir
