"""Everything a training session consists of, put together and restored."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from flashdex.algorithms.base import Learner
from flashdex.envs.scene.scene import build_scenes
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import RunError
from flashdex.recipe import dump_recipe
from flashdex.replay.disk import ReplayLog, replay_of
from flashdex.rollouts.ledger import Ledger
from flashdex.rollouts.scorer import (
    InlineScorer,
    ProcessScorer,
    Scorer,
    ScorerSpec,
)
from flashdex.system.files import write_atomic
from flashdex.system.machine import versions
from flashdex.training.baselines import score_baselines
from flashdex.training.build import Workbench, open_workbench
from flashdex.training.checkpoint import checkpoint_name, checkpoint_names
from flashdex.training.logging import MetricLog
from flashdex.training.session import Start, begin_session
from flashdex.training.trainer import Trainer

_LOG = logging.getLogger(__name__)
RECIPE, BASELINES = "recipe.yaml", "baselines.json"
Trivial = dict[str, list[str]]
"""Motions that a baseline already passes, and which ones do."""


def make_trainer(
    bench: Workbench,
    run_dir: Path,
    state: dict[str, Any] | None,
    overrides: list[str],
) -> Trainer:
    """Build the trainer of a session, and write the session's first line.

    Args:
        bench: motions and recipe, overrides included.
        run_dir: run directory, locked.
        state: checkpoint to go on from, or None.
        overrides: what the recipe was changed by.

    Raises:
        RunError: the checkpoint does not fit the recipe; nothing is changed then.
    """
    recipe = bench.recipe
    env = bench.make_env()
    learner = bench.make_learner(env)
    if state is not None:
        restore(learner, state)
    if overrides:
        write_atomic(run_dir / RECIPE, dump_recipe(recipe))
        (run_dir / BASELINES).unlink(missing_ok=True)  # other physics, other scores
    baselines = score_baselines(bench, run_dir / BASELINES)
    trivial = baselines.trivial(recipe.train.criterion)
    on_gpu = env.device.type == "cuda"
    ledger = _open_ledger(bench, run_dir, trivial, on_gpu=on_gpu)
    start = begin_session(
        run_dir,
        env_steps=state["env_steps"] if state else 0,
        wall_s=state["wall_s"] if state else 0.0,
        overrides=overrides,
    )
    _check_ledger(ledger, state, start)
    log = MetricLog(
        run_dir,
        recipe,
        wandb_id=state["wandb_id"] if state else None,
        env_steps=start.env_steps,
    )
    replay = _open_replay(bench, run_dir, learner, state)
    scorer = _make_scorer(bench, run_dir, env, ledger)
    trainer = Trainer(
        recipe,
        run_dir,
        env,
        learner,
        ledger,
        scorer,
        log,
        start=start,
        replay=replay,
    )
    if state is not None:
        trainer.load_state_dict(state)
    return trainer


def _open_ledger(
    bench: Workbench, run_dir: Path, trivial: Trivial, *, on_gpu: bool
) -> Ledger:
    recipe = bench.recipe
    return Ledger(
        run_dir,
        bench.bank.names,
        criterion=recipe.train.criterion,
        seed=recipe.seed,
        engine=recipe.physics.engine,
        on_gpu=on_gpu,
        certify=recipe.train.certify,
        trivial=trivial,
    )


def _make_scorer(
    bench: Workbench, run_dir: Path, env: TrackingEnv, ledger: Ledger
) -> Scorer:
    """In the loop, or in a process where the physics would wait for it."""
    recipe, provenance = bench.recipe, _provenance(bench)
    made_by = versions(recipe.physics.engine, env.device)
    where = recipe.train.judge
    if where == "inline" or (where == "auto" and env.is_host_device):
        scenes = env.physics.scenes
        builder = bench.rollout_builder(scenes, made_by=made_by, provenance=provenance)
        return InlineScorer(ledger, builder)
    # The process must not prepare the motions again: name the library that is used.
    motions = dataclasses.replace(recipe.motions, library=str(bench.library.path))
    spec = ScorerSpec(
        dataclasses.replace(recipe, motions=motions),
        run_dir,
        made_by,
        provenance,
        ledger.trivial,
        ledger.on_gpu,
    )
    return ProcessScorer(ledger, spec, make_inline_scorer)


def make_inline_scorer(spec: ScorerSpec) -> InlineScorer:
    """Build the scorer of the scoring process.

    Args:
        spec: what the run told it.
    """
    bench = open_workbench(spec.recipe, device=torch.device("cpu"))
    scenes = build_scenes(bench.library, bench.hands, spec.recipe.physics)
    builder = bench.rollout_builder(
        scenes, made_by=spec.made_by, provenance=spec.provenance
    )
    ledger = _open_ledger(bench, spec.run_dir, spec.trivial, on_gpu=spec.on_gpu)
    return InlineScorer(ledger, builder)


def _provenance(bench: Workbench) -> dict[str, str]:
    """Where a rollout comes from, apart from the versions stored with it."""
    manifest = (bench.library.path / "manifest.json").read_bytes()
    return {
        "recipe_sha256": hashlib.sha256(dump_recipe(bench.recipe).encode()).hexdigest(),
        "library_sha256": hashlib.sha256(manifest).hexdigest(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def restore(learner: Learner, state: dict[str, Any]) -> None:
    """Put a checkpoint into a learner; its worlds begin new episodes.

    Args:
        learner: as the recipe makes it.
        state: checkpoint.

    Raises:
        RunError: it is of other networks, observations or worlds.
    """
    try:
        learner.load_state_dict(state["learner"])
    except (RuntimeError, KeyError, ValueError) as error:
        lines = [line.strip() for line in str(error).splitlines()]
        fault = " ".join(lines[:2])
        raise RunError(
            "the checkpoint does not fit the recipe: an override changed the networks, "
            "the observation or env.num_envs, or another version of flashdex wrote it "
            f"({fault}{' ...' if len(lines) > 2 else ''}). Leave the override out, use "
            "that version, or start a new run."
        ) from error
    learner.forget_episodes()


def _check_ledger(ledger: Ledger, state: dict[str, Any] | None, start: Start) -> None:
    """Say what the ledger lost, and take in what a crash left without a line."""
    if state is not None and ledger.num_bytes < state["ledger_bytes"]:
        _LOG.warning(
            "%s is shorter than at the checkpoint: attempts are missing", ledger.path
        )
    for name in ledger.adopt(wall_s=start.wall_s):
        _LOG.info("%s: its stored rollout had no line yet, and has one now", name)


def _open_replay(
    bench: Workbench, run_dir: Path, learner: Learner, state: dict[str, Any] | None
) -> ReplayLog | None:
    """The files of the replay buffer, and its rows as they were at the checkpoint."""
    buffer = replay_of(learner)
    if buffer is None:
        return None
    recipe = bench.recipe
    rows = {
        "library": _provenance(bench)["library_sha256"],
        "motions": bench.bank.names,
        "env": dataclasses.asdict(recipe.env),
        "physics": dataclasses.asdict(recipe.physics),
        "return": [recipe.algo.n_step, recipe.algo.gamma],
    }
    text = json.dumps(rows, sort_keys=True)
    log = ReplayLog(
        run_dir,
        buffer,
        meaning=hashlib.sha256(text.encode()).hexdigest(),
        enabled=recipe.train.checkpoint_replay,
    )
    log.prune(checkpoint_names(run_dir))
    if state is not None and log.load(checkpoint_name(state["env_steps"])):
        _LOG.info("%d replay rows are back", len(buffer))
    return log
