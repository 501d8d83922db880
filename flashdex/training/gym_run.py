"""Runs on a stock environment: start, resume and evaluate them."""

from __future__ import annotations

import contextlib
import json
import logging
import math
from pathlib import Path
from typing import Any

import torch

from flashdex.algorithms.flashsac import GymLearner
from flashdex.envs.gym import GymWorlds
from flashdex.errors import FlashdexError, RunError
from flashdex.recipe import GymRecipe, dump_recipe, expect_kind, load_recipe
from flashdex.replay.disk import ReplayLog
from flashdex.system.allocator import keep_freed_memory
from flashdex.system.files import run_lock, write_atomic
from flashdex.training.checkpoint import (
    checkpoint_name,
    checkpoint_names,
    has_checkpoint,
    load_checkpoint,
    remove_temporaries,
    set_aside_newer,
)
from flashdex.training.evaluator import evaluate_recipe
from flashdex.training.gym_trainer import GymTrainer
from flashdex.training.logging import MetricLog
from flashdex.training.run_dir import RECIPE, create_run_dir, default_run_dir
from flashdex.training.session import begin_session, end_session

_LOG = logging.getLogger(__name__)


def train_gym(recipe: GymRecipe) -> Path:
    """Train a recipe from the beginning; return its run directory.

    Args:
        recipe: validated recipe.

    Raises:
        FlashdexError: the environment cannot be used.
        RunError: the folder already holds a run.
    """
    run_dir = default_run_dir(recipe)
    if (run_dir / RECIPE).exists():
        raise RunError(
            f"{run_dir}: already holds a run. Continue it with 'flashdex train "
            f"--resume {run_dir}', or choose another folder with run_dir=..."
        )
    learner = make_gym_learner(recipe)
    create_run_dir(run_dir, recipe)
    with run_lock(run_dir):
        return _train(recipe, learner, run_dir, None, [])


def resume_gym(run: str | Path, overrides: list[str] | None = None) -> Path:
    """Continue a run from its newest checkpoint, or from the start without one.

    Args:
        run: run directory.
        overrides: ``key=value`` changes to the stored recipe.
    """
    run_dir, overrides = Path(run), overrides or []
    recipe = load_gym_recipe(run_dir, overrides)
    learner = make_gym_learner(recipe)
    with run_lock(run_dir):
        remove_temporaries(run_dir)
        state = None
        if has_checkpoint(run_dir):
            state = load_checkpoint(run_dir)
            set_aside_newer(run_dir, state["env_steps"])
        else:
            _LOG.warning("%s: stopped before its first checkpoint, from 0", run_dir)
        return _train(recipe, learner, run_dir, state, overrides)


def load_gym_recipe(run_dir: Path, overrides: list[str] | None = None) -> GymRecipe:
    """Read the recipe a run was started with."""
    recipe = load_recipe(run_dir / RECIPE, overrides or [])
    return expect_kind(recipe, GymRecipe, where=str(run_dir))


def make_gym_learner(recipe: GymRecipe) -> GymLearner:
    """Build networks, loss and replay for the environment of a recipe.

    Raises:
        FlashdexError: the environment cannot be used.
    """
    if recipe.algo.device == "cuda":
        raise FlashdexError(
            "algo.device: a gym recipe learns on the CPU, beside its environments. Use "
            "algo.device=cpu or auto."
        )
    keep_freed_memory()
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)
    worlds = GymWorlds(recipe.gym, num_envs=1, seed=recipe.seed)
    steps = recipe.schedule_env_steps / recipe.gym.num_envs
    learner = GymLearner(
        recipe.algo,
        observation_dim=worlds.observation_dim,
        action_dim=worlds.action_dim,
        num_envs=recipe.gym.num_envs,
        total_updates=max(1, math.ceil(steps * recipe.algo.updates_per_step)),
        seed=recipe.seed,
    )
    worlds.close()
    return learner


def _train(
    recipe: GymRecipe,
    learner: GymLearner,
    run_dir: Path,
    state: dict[str, Any] | None,
    overrides: list[str],
) -> Path:
    """Train from a checkpoint, or from the beginning when there is none."""
    if state is not None:
        _restore(learner, state)
    if overrides:  # only now that the checkpoint turned out to fit them
        write_atomic(run_dir / RECIPE, dump_recipe(recipe))
    start = begin_session(
        run_dir,
        env_steps=state["env_steps"] if state else 0,
        wall_s=state["wall_s"] if state else 0.0,
        overrides=overrides,
    )
    gym, algo = recipe.gym, recipe.algo
    rows = [gym.env_id, gym.max_episode_steps, gym.rescale_actions, algo.n_step]
    wandb_id = state["wandb_id"] if state else None
    log = MetricLog(run_dir, recipe, wandb_id=wandb_id, env_steps=start.env_steps)
    replay = ReplayLog(
        run_dir,
        learner.buffer,
        meaning=str([*rows, algo.gamma]),
        enabled=recipe.train.checkpoint_replay,
    )
    replay.prune(checkpoint_names(run_dir))
    if state is not None and replay.load(checkpoint_name(start.env_steps)):
        _LOG.info("%d replay rows are back", learner.num_rows)
    trainer = GymTrainer(recipe, run_dir, learner, log, start=start, replay=replay)
    why = "error"
    try:
        why = trainer.run()
    finally:
        log.close()
        with contextlib.suppress(OSError):  # the disk may be what ended it
            end_session(
                run_dir, why, env_steps=trainer.env_steps, wall_s=trainer.wall_s
            )
    _LOG.info("ended after %d env steps: %s", trainer.env_steps, why)
    return run_dir


def _restore(learner: GymLearner, state: dict[str, Any]) -> None:
    try:
        learner.load_state_dict(state["learner"])
    except (RuntimeError, KeyError) as error:
        # torch names every tensor that differs; the first one tells enough
        lines = [line.strip() for line in str(error).splitlines()]
        fault = " ".join(lines[:2])
        raise RunError(
            "the checkpoint does not fit the recipe: an override changed the networks, "
            "the environment or gym.num_envs, or another version of flashdex wrote it "
            f"({fault}{' ...' if len(lines) > 2 else ''}). Go on without the override "
            "or with that version, or start a new run."
        ) from error
    learner.forget_episodes()


def evaluate_gym(run: str | Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """Play the evaluation episodes with the newest policy of a run.

    Args:
        run: run directory with a checkpoint.
        overrides: changes to the stored recipe, ``gym.eval_episodes=100`` for instance.

    Returns:
        Env steps, metrics and the return of each episode, also written to
        ``evaluation.json`` in the run.
    """
    run_dir = Path(run)
    recipe = load_gym_recipe(run_dir, overrides)
    state = load_checkpoint(run_dir)
    learner = make_gym_learner(recipe)
    _restore(learner, state)
    found = evaluate_recipe(recipe, learner)
    result = {
        "env_id": recipe.gym.env_id,
        "env_steps": state["env_steps"],
        **found.metrics(),
        "returns": [round(value, 3) for value in found.returns.tolist()],
    }
    write_atomic(run_dir / "evaluation.json", json.dumps(result, indent=1))
    return result
