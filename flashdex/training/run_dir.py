"""Run directories: start, resume and evaluate the runs of every kind of recipe."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Collection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase

from flashdex.algorithms.base import Learner
from flashdex.errors import FlashdexError, RecipeError, RunError, is_of_machine
from flashdex.recipe import GymRecipe, RunRecipe, SearchRecipe, dump_recipe, load_recipe
from flashdex.replay.disk import ReplayLog
from flashdex.system.allocator import keep_freed_memory
from flashdex.system.files import RunHold
from flashdex.system.jsonl import write_object
from flashdex.system.run_files import (
    CHECKPOINTS,
    EVALUATION,
    RECIPE,
    check_run,
    check_sessions,
    new_run,
    read_recipe,
    refuse_old_run,
    reported,
    resumed_run,
    run_id,
    write_recipe,
)
from flashdex.training.checkpoint import (
    checkpoint_name,
    checkpoint_names,
    has_checkpoint,
    load_checkpoint,
    set_aside_newer,
)
from flashdex.training.guard import GradientGuard, numeric_errors, read_dump
from flashdex.training.logging import MetricLog, check_writers
from flashdex.training.session import (
    begin_session,
    end_session,
    interruptible,
    refuse_changes,
    stored_value,
)
from flashdex.training.tasks.base import Task
from flashdex.training.tasks.gym import GymTask
from flashdex.training.tasks.tracking import TrackingTask
from flashdex.training.trainer import Trainer

_LOG = logging.getLogger(__name__)


def default_run_dir(recipe: RunRecipe) -> Path:
    """Folder of a run: the recipe's, or one named after recipe, ablation and seed."""
    if recipe.run_dir is not None:
        return Path(recipe.run_dir)
    return Path("runs") / f"{recipe.name}-{recipe.ablation}-s{recipe.seed}"


def task_of(recipe: RunRecipe) -> type[Task]:
    """What a recipe trains.

    Raises:
        FlashdexError: nothing, it is of a search.
    """
    if isinstance(recipe, SearchRecipe):
        raise FlashdexError(
            f"'{recipe.name}' has task: search, which trains nothing; use 'flashdex "
            "search'"
        )
    return GymTask if isinstance(recipe, GymRecipe) else TrackingTask


def train(recipe: RunRecipe, overrides: Collection[str] = ()) -> Path:
    """Train a recipe from the beginning; return its run directory.

    Args:
        recipe: composed.
        overrides: ``key=value`` words it was composed with, for the run's records.

    Raises:
        RunError: the folder already holds a run.
    """
    kind, run_dir = task_of(recipe), default_run_dir(recipe)
    refuse_old_run(run_dir)  # at once, before motions are prepared
    check_writers(recipe)
    with interruptible():
        task = kind.open(recipe, run_dir)
    with new_run(run_dir, dump_recipe(recipe)) as hold:
        return _train(task, hold, None, list(overrides), changed=False)


def resume(run: str | Path, overrides: list[str] | None = None) -> Path:
    """Continue a run from its newest checkpoint, or from the start without one.

    Raises:
        RunError: another process trains there, or the checkpoint does not fit the
            overrides or the run; the run is as it was then.
    """
    run_dir, overrides = Path(run), overrides or []
    recipe = load_run_recipe(run_dir, overrides)
    check_writers(recipe)
    with resumed_run(run_dir) as hold:
        state = None
        if has_checkpoint(run_dir):
            state = _load_state(run_dir, task_of(recipe).resumed_keys)
            refuse_changes(_stored_recipe(run_dir, state), recipe)
        with interruptible():
            task = task_of(recipe).open(recipe, run_dir)
        task.check_inputs(run_dir)
        # Nothing of the run is touched before all that could refuse it.
        if state is not None:
            with reported(run_dir):
                set_aside_newer(run_dir, state["env_steps"])
        else:
            _LOG.warning("%s: stopped before its first checkpoint, from 0", run_dir)
        return _train(task, hold, state, overrides, changed=bool(overrides))


def evaluate(run: str | Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """Evaluate the newest policy of a run, as its kind of recipe does.

    Where the run cannot be written a warning says so at once, and the scores are only
    returned.

    Returns:
        What is written to ``evaluation.json`` in the run.
    """
    run_dir = Path(run)
    load_run_recipe(run_dir, overrides)
    if not os.access(run_dir, os.W_OK):
        _LOG.warning("%s cannot be written: the scores are only shown", run_dir)
    task, learner, env_steps = load_learner(run_dir, overrides)
    _set_up_process(task.recipe)
    result = task.evaluate(learner, env_steps)
    try:
        write_object(result, run_dir, EVALUATION)
    except OSError as error:
        _LOG.warning("%s is not written (%s)", run_dir / EVALUATION, error.strerror)
    return result


def load_learner(
    run_dir: Path, overrides: list[str] | None = None
) -> tuple[Task, Learner, int]:
    """The task of a run, its learner as it was stored last, and its env steps.

    Raises:
        RunError: the folder holds no run, none with a checkpoint that can be read, or
            its motions are others now.
    """
    recipe = load_run_recipe(run_dir, overrides)
    state = _load_state(run_dir, task_of(recipe).evaluated_keys)
    task = task_of(recipe).open(recipe)
    # somebody who names other motions wants them
    if not any(word.lstrip("+~").startswith("motions") for word in overrides or []):
        task.check_inputs(run_dir)
    # The learner keeps a running return a world: as many as it was trained with.
    num_envs = stored_value(_stored_recipe(run_dir, state), task.worlds_key)
    learner = task.make_learner(task.make_env(num_envs=num_envs))
    restore(learner, state, worlds_key=task.worlds_key)
    return task, learner, state["env_steps"]


def load_run_recipe(run_dir: Path, overrides: list[str] | None = None) -> RunRecipe:
    """Read the recipe a run was started with, as ``resume`` would go on with it.

    Raises:
        RunError: the folder holds no run, its recipe is damaged, or something else
            stands where the run has a file.
    """
    read_recipe(run_dir)
    check_run(run_dir)
    check_sessions(run_dir, counts=False)
    return load_recipe(run_dir / RECIPE, overrides or [])


def _load_state(run_dir: Path, needs: Collection[str]) -> dict[str, Any]:
    """The newest checkpoint of this very run.

    Raises:
        RunError: see ``load_checkpoint``; or it was made by another run.
    """
    state, own = load_checkpoint(run_dir, needs), run_id(run_dir)
    if state.get("run") != own:
        raise RunError(
            f"{run_dir / CHECKPOINTS}: its newest checkpoint was made by another run "
            "than this one. Move it away to go on from the one before."
        )
    return state


def _stored_recipe(run_dir: Path, state: dict[str, Any]) -> str:
    """Recipe of a checkpoint; those of stock environments once had none."""
    return state.get("recipe") or read_recipe(run_dir)


def _set_up_process(recipe: Any) -> None:
    keep_freed_memory()
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)


def _train(
    task: Task,
    hold: RunHold,
    state: dict[str, Any] | None,
    overrides: list[str],
    *,
    changed: bool,
) -> Path:
    """Train from a checkpoint, or from the beginning when there is none."""
    _set_up_process(task.recipe)
    with reported(hold.path):
        with interruptible():
            trainer = make_trainer(
                task, hold.path, state, overrides, changed=changed, hold=hold
            )
        why = "error"
        try:
            why = trainer.run()
        finally:
            _end(trainer, hold, why)
    _LOG.info("ended after %d env steps: %s", trainer.env_steps, why)
    return hold.path


def _end(trainer: Trainer, hold: RunHold, why: str) -> None:
    """Close what is open; a run that fails already keeps its own error."""
    quiet = [] if why != "error" else [OSError, RunError]
    with contextlib.suppress(*quiet):
        trainer.close(wait=why != "error")
    try:
        hold.check()
        end_session(hold.path, why, env_steps=trainer.env_steps, wall_s=trainer.wall_s)
    # the disk may be what ended it, or the folder is no longer there
    except (OSError, RunError) as error:
        if why != "error":  # which is told anyhow
            _LOG.warning("the end of the session is not recorded: %s", error)


def make_trainer(
    task: Task,
    run_dir: Path,
    state: dict[str, Any] | None = None,
    overrides: list[str] | None = None,
    *,
    changed: bool = False,
    hold: RunHold | None = None,
) -> Trainer:
    """Build the trainer of a session, and write the session's first line.

    ``changed``: the overrides are not in the stored recipe yet. ``hold``: of the
    folder, for the trainer to look after.

    Raises:
        RunError: the checkpoint does not fit the recipe; nothing is changed then.
    """
    torch.manual_seed(task.recipe.seed)
    env = task.make_env()
    learner = task.make_learner(env)
    if state is not None:
        restore(learner, state, worlds_key=task.worlds_key)
    start = begin_session(
        run_dir,
        env_steps=state["env_steps"] if state else 0,
        wall_s=state["wall_s"] if state else 0.0,
        overrides=overrides or [],
        before=read_recipe(run_dir) if changed else "",
    )
    if changed:  # after the line that keeps the one before
        write_recipe(run_dir, dump_recipe(task.recipe))
    task.prepare(run_dir, env)
    log = MetricLog(
        run_dir,
        task.recipe,
        wandb_id=state["wandb_id"] if state else None,
        env_steps=start.env_steps,
    )
    replay = _open_replay(task, run_dir, learner, state)
    task.begin(start, state)
    trainer = Trainer(
        task, run_dir, learner, log, start=start, replay=replay, hold=hold
    )
    if state is not None:
        trainer.load_state_dict(state)
    return trainer


def restore(learner: Learner, state: dict[str, Any], *, worlds_key: str) -> None:
    """Put a checkpoint into a learner; its worlds begin new episodes.

    Raises:
        RunError: it is of other networks, observations or worlds.
    """
    _load(learner, state["learner"], worlds_key=worlds_key)
    learner.forget_episodes()


def _load(learner: Learner, state: dict[str, Any], *, worlds_key: str) -> None:
    try:
        learner.load_state_dict(state)
    except (RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        if is_of_machine(error):
            raise
        # torch names every tensor that differs; the first one tells enough
        lines = [line.strip() for line in str(error).splitlines()]
        fault = " ".join(lines[:2])
        raise RunError(
            "the checkpoint does not fit the recipe: an override changed the networks, "
            f"the observation or {worlds_key}, or another version of flashdex wrote it "
            f"({fault}{' ...' if len(lines) > 2 else ''}). Leave the override out, use "
            "that version, or start a new run."
        ) from error


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
        try:
            recipe = load_recipe(file)
        except RecipeError as error:
            where = f"{path}, its recipe"
            raise RecipeError(error.problems, where=where) from error
    task = task_of(recipe).open(recipe)
    learner = task.make_learner(task.make_env())
    _load(learner, dump["learner"], worlds_key=task.worlds_key)
    update = dump["update"]
    if update is None:
        raise RunError(f"{path}: holds no batch; this learner keeps none.")

    def repeat() -> TensorDictBase:
        torch.set_rng_state(dump["torch_rng"])
        with GradientGuard(waits=True), numeric_errors(learner):
            return learner.redo(update)

    return learner, repeat
