"""Run directories: start, resume and evaluate the runs of every kind of recipe."""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase

from flashdex.algorithms.base import Learner
from flashdex.errors import RunError
from flashdex.recipe import GymRecipe, RunRecipe, dump_recipe, load_recipe
from flashdex.replay.disk import ReplayLog
from flashdex.system.allocator import keep_freed_memory
from flashdex.system.files import run_lock, write_atomic
from flashdex.system.machine import versions
from flashdex.training.checkpoint import (
    checkpoint_name,
    checkpoint_names,
    has_checkpoint,
    load_checkpoint,
    remove_temporaries,
    set_aside_newer,
)
from flashdex.training.guard import GradientGuard, numeric_errors, read_dump
from flashdex.training.gym import GymTask
from flashdex.training.logging import MetricLog, check_writers
from flashdex.training.session import (
    begin_session,
    end_session,
    refuse_changes,
    stored_value,
)
from flashdex.training.task import Task
from flashdex.training.tracking import TrackingTask
from flashdex.training.trainer import Trainer

_LOG = logging.getLogger(__name__)
RECIPE, VERSIONS = "recipe.yaml", "versions.json"


def default_run_dir(recipe: RunRecipe) -> Path:
    """Folder of a run: the recipe's, or one named after recipe, ablation and seed."""
    if recipe.run_dir is not None:
        return Path(recipe.run_dir)
    return Path("runs") / f"{recipe.name}-{recipe.ablation}-s{recipe.seed}"


def task_of(recipe: RunRecipe) -> type[Task]:
    """What a recipe trains."""
    return GymTask if isinstance(recipe, GymRecipe) else TrackingTask


def train(recipe: RunRecipe) -> Path:
    """Train a recipe from the beginning; return its run directory.

    Raises:
        RunError: the folder already holds a run.
    """
    run_dir = default_run_dir(recipe)
    refuse_old_run(run_dir)  # at once, before motions are prepared
    check_writers(recipe)
    task = task_of(recipe).open(recipe, run_dir)
    with new_run(run_dir, recipe):
        return _train(task, run_dir, None, [])


def resume(run: str | Path, overrides: list[str] | None = None) -> Path:
    """Continue a run from its newest checkpoint, or from the start without one.

    Raises:
        RunError: another process trains there, or the checkpoint does not fit the
            overrides; the run is as it was then.
    """
    run_dir, overrides = Path(run), overrides or []
    recipe = load_run_recipe(run_dir, overrides)
    check_writers(recipe)
    with run_lock(run_dir):
        remove_temporaries(run_dir)
        state = None
        if has_checkpoint(run_dir):
            state = load_checkpoint(run_dir, task_of(recipe).resumed_keys)
            refuse_changes(_stored_recipe(run_dir, state), recipe)
        task = task_of(recipe).open(recipe, run_dir)
        # Nothing of the run is touched before all that could refuse it.
        if state is not None:
            set_aside_newer(run_dir, state["env_steps"])
        else:
            _LOG.warning("%s: stopped before its first checkpoint, from 0", run_dir)
        return _train(task, run_dir, state, overrides)


def evaluate(run: str | Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """Evaluate the newest policy of a run, as its kind of recipe does.

    Returns:
        What is written to ``evaluation.json`` in the run.
    """
    task, learner, env_steps = load_learner(Path(run), overrides)
    _set_up_process(task.recipe)
    result = task.evaluate(learner, env_steps)
    write_atomic(Path(run) / "evaluation.json", json.dumps(result, indent=1))
    return result


def load_learner(
    run_dir: Path, overrides: list[str] | None = None
) -> tuple[Task, Learner, int]:
    """The task of a run, its learner as it was stored last, and its env steps.

    Raises:
        RunError: the folder holds no run, or none with a checkpoint that can be read.
    """
    recipe = load_run_recipe(run_dir, overrides)
    state = load_checkpoint(run_dir, task_of(recipe).evaluated_keys)
    task = task_of(recipe).open(recipe)
    # The learner keeps a running return a world: as many as it was trained with.
    num_envs = stored_value(_stored_recipe(run_dir, state), task.worlds_key)
    learner = task.make_learner(task.make_env(num_envs=num_envs))
    restore(learner, state, worlds_key=task.worlds_key)
    return task, learner, state["env_steps"]


def load_run_recipe(run_dir: Path, overrides: list[str] | None = None) -> RunRecipe:
    """Read the recipe a run was started with, as ``resume`` would go on with it."""
    path = run_dir / RECIPE
    if not path.is_file():
        raise RunError(f"{run_dir}: not a run directory, there is no {RECIPE} in it.")
    return load_recipe(path, overrides or [])


def _stored_recipe(run_dir: Path, state: dict[str, Any]) -> str:
    """Recipe of a checkpoint; those of stock environments once had none."""
    return state.get("recipe") or (run_dir / RECIPE).read_text(encoding="utf-8")


@contextlib.contextmanager
def new_run(run_dir: Path, recipe: RunRecipe) -> Iterator[None]:
    """Make the folder of a new run and hold it; nobody else may start one in it.

    Raises:
        RunError: it holds a run, another process is at it, or it cannot be written.
    """
    with contextlib.ExitStack() as held:
        with _reported(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
            held.enter_context(run_lock(run_dir))
        refuse_old_run(run_dir)  # another process may have just ended one
        with _reported(run_dir):
            write_atomic(run_dir / VERSIONS, json.dumps(versions(), indent=1))
            if diff := _git("diff", "HEAD"):
                write_atomic(run_dir / "git.diff", diff)
            write_atomic(run_dir / RECIPE, dump_recipe(recipe))
        yield


def refuse_old_run(run_dir: Path) -> None:
    """Raise a RunError when the folder already holds a run."""
    if (run_dir / RECIPE).exists():
        raise RunError(
            f"{run_dir}: already holds a run. Continue it with 'flashdex train "
            f"--resume {run_dir}', or choose another folder with run_dir=..."
        )


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
    words = ["git", "-C", str(root), *args]
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=10, check=False
        )
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _set_up_process(recipe: Any) -> None:
    keep_freed_memory()
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)


def _train(
    task: Task, run_dir: Path, state: dict[str, Any] | None, overrides: list[str]
) -> Path:
    """Train from a checkpoint, or from the beginning when there is none."""
    _set_up_process(task.recipe)
    trainer = make_trainer(task, run_dir, state, overrides)
    why = "error"
    try:
        why = trainer.run()
    finally:
        trainer.close(wait=why != "error")
        with contextlib.suppress(OSError):  # the disk may be what ended it
            end_session(
                run_dir, why, env_steps=trainer.env_steps, wall_s=trainer.wall_s
            )
    _LOG.info("ended after %d env steps: %s", trainer.env_steps, why)
    return run_dir


def make_trainer(
    task: Task,
    run_dir: Path,
    state: dict[str, Any] | None = None,
    overrides: list[str] | None = None,
) -> Trainer:
    """Build the trainer of a session, and write the session's first line.

    Raises:
        RunError: the checkpoint does not fit the recipe; nothing is changed then.
    """
    overrides = overrides or []
    torch.manual_seed(task.recipe.seed)
    env = task.make_env()
    learner = task.make_learner(env)
    if state is not None:
        restore(learner, state, worlds_key=task.worlds_key)
    if overrides:
        write_atomic(run_dir / RECIPE, dump_recipe(task.recipe))
    task.prepare(run_dir, env, changed=bool(overrides))
    start = begin_session(
        run_dir,
        env_steps=state["env_steps"] if state else 0,
        wall_s=state["wall_s"] if state else 0.0,
        overrides=overrides,
    )
    log = MetricLog(
        run_dir,
        task.recipe,
        wandb_id=state["wandb_id"] if state else None,
        env_steps=start.env_steps,
    )
    replay = _open_replay(task, run_dir, learner, state)
    task.begin(start, state)
    trainer = Trainer(task, run_dir, learner, log, start=start, replay=replay)
    if state is not None:
        trainer.load_state_dict(state)
    return trainer


def restore(learner: Learner, state: dict[str, Any], *, worlds_key: str) -> None:
    """Put a checkpoint into a learner; its worlds begin new episodes.

    Raises:
        RunError: it is of other networks, observations or worlds.
    """
    try:
        learner.load_state_dict(state["learner"])
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        # torch names every tensor that differs; the first one tells enough
        lines = [line.strip() for line in str(error).splitlines()]
        fault = " ".join(lines[:2])
        raise RunError(
            "the checkpoint does not fit the recipe: an override changed the networks, "
            f"the observation or {worlds_key}, or another version of flashdex wrote it "
            f"({fault}{' ...' if len(lines) > 2 else ''}). Leave the override out, use "
            "that version, or start a new run."
        ) from error
    learner.forget_episodes()


def _open_replay(
    task: Task, run_dir: Path, learner: Learner, state: dict[str, Any] | None
) -> ReplayLog | None:
    """The files of the replay buffer, and its rows as they were at the checkpoint."""
    if learner.buffer is None:
        return None
    log = ReplayLog(
        run_dir,
        learner.buffer,
        meaning=task.rows_meaning,
        enabled=task.recipe.train.checkpoint_replay,
    )
    log.prune(checkpoint_names(run_dir))
    if state is not None and log.load(checkpoint_name(state["env_steps"])):
        _LOG.info("%d replay rows are back", learner.num_rows)
    return log


def reopen(path: str | Path) -> tuple[Learner, Callable[[], TensorDictBase]]:
    """The learner of a ``nan_dump.pt`` as it was, and a function that fails again.

    It performs the update again under the guard: NonFiniteError, or the metrics. The
    motion library must still be there.

    Raises:
        RunError: no such file, not a dump, or a learner that keeps no batch.

    Example:
        >>> learner, repeat = reopen("runs/a/nan_dump.pt")  # doctest: +SKIP
        >>> repeat()  # doctest: +SKIP
        flashdex.training.guard.NonFiniteError: gradient of parameter 0, (64, 218)
    """
    dump = read_dump(Path(path))
    with TemporaryDirectory() as folder:
        file = Path(folder) / RECIPE
        file.write_text(dump["recipe"], encoding="utf-8")
        recipe = load_recipe(file)
    task = task_of(recipe).open(recipe)
    learner = task.make_learner(task.make_env())
    learner.load_state_dict(dump["learner"])
    update = dump["update"]
    if update is None:
        raise RunError(f"{path}: holds no batch; this learner keeps none.")

    def repeat() -> TensorDictBase:
        torch.set_rng_state(dump["torch_rng"])
        with GradientGuard(waits=True), numeric_errors(learner):
            return learner.redo(update)

    return learner, repeat
