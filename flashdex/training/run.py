"""Run directories: start a training run, resume it, write what it leaves behind."""

from __future__ import annotations

import hashlib
import json
import logging
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.files import write_atomic
from flashdex.recipe import Recipe, dump_recipe, load_recipe
from flashdex.training.attempts import versions
from flashdex.training.baselines import score_baselines
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.ledger import Ledger
from flashdex.training.logging import MetricLog
from flashdex.training.loop import Trainer
from flashdex.training.setup import Workbench, open_workbench

_LOG = logging.getLogger(__name__)
RECIPE, VERSIONS, BASELINES = "recipe.yaml", "versions.json", "baselines.json"


def default_run_dir(recipe: Recipe) -> Path:
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
    if (run_dir / RECIPE).exists():
        raise RunError(
            f"{run_dir}: already holds a run. Continue it with 'flashdex train "
            f"--resume {run_dir}', or choose another folder with run_dir=..."
        )
    bench = open_workbench(recipe)
    create_run_dir(run_dir, recipe)
    return _train(bench, run_dir, None)


def resume(run: str | Path, overrides: list[str] | None = None) -> Path:
    """Continue a run from its newest checkpoint.

    Args:
        run: run directory.
        overrides: ``key=value`` changes to the stored recipe.
    """
    run_dir = Path(run)
    recipe = load_run_recipe(run_dir, overrides)
    state = load_checkpoint(run_dir)
    if overrides:
        write_atomic(run_dir / RECIPE, dump_recipe(recipe))
        (run_dir / BASELINES).unlink(missing_ok=True)  # other physics, other scores
    return _train(open_workbench(recipe), run_dir, state)


def load_run_recipe(run_dir: Path, overrides: list[str] | None = None) -> Recipe:
    """Read the recipe a run was started with."""
    path = run_dir / RECIPE
    if not path.is_file():
        raise RunError(f"{run_dir}: not a run directory, there is no {RECIPE} in it.")
    return load_recipe(path, overrides or [])


def create_run_dir(run_dir: Path, recipe: Recipe) -> None:
    """Make the folder with recipe, versions and the state of the source tree."""
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        write_atomic(run_dir / VERSIONS, json.dumps(versions(), indent=1))
        diff = _git("diff", "HEAD")
        if diff:
            write_atomic(run_dir / "git.diff", diff)
        write_atomic(run_dir / RECIPE, dump_recipe(recipe))
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


def _provenance(bench: Workbench) -> dict[str, str]:
    """Where a rollout comes from, apart from the versions stored with it."""
    manifest = (bench.library.path / "manifest.json").read_bytes()
    return {
        "recipe_sha256": hashlib.sha256(dump_recipe(bench.recipe).encode()).hexdigest(),
        "library_sha256": hashlib.sha256(manifest).hexdigest(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _train(bench: Workbench, run_dir: Path, state: dict[str, Any] | None) -> Path:
    recipe = bench.recipe
    torch.manual_seed(recipe.seed)
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)
    baselines = score_baselines(bench, run_dir / BASELINES)
    env = bench.make_env()
    learner = bench.make_learner(env)
    ledger = Ledger(
        run_dir,
        bench.bank.names,
        criterion=recipe.train.criterion,
        seed=recipe.seed,
        engine=recipe.physics.engine,
        certify=recipe.train.certify,
        trivial=baselines.trivial(recipe.train.criterion),
    )
    log = MetricLog(run_dir, recipe, wandb_id=state["wandb_id"] if state else None)
    trainer = Trainer(
        recipe, run_dir, env, learner, ledger, log, provenance=_provenance(bench)
    )
    if state is not None:
        trainer.load_state_dict(state)
    try:
        why = trainer.run()
    finally:
        log.close()
    _LOG.info("ended after %d env steps: %s", trainer.env_steps, why)
    return run_dir
