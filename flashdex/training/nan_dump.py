"""``nan_dump.pt``: everything to repeat the update that was not finite."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase

from flashdex.algorithms.base import Learner, snapshot
from flashdex.errors import RunError
from flashdex.recipe import Recipe, dump_recipe, expect_kind, load_recipe
from flashdex.system.files import open_atomic
from flashdex.training.checkpoint import FORMAT, check_format, newest_checkpoint
from flashdex.training.guard import (
    GradientGuard,
    first_non_finite,
    numeric_errors,
)

DUMP = "nan_dump.pt"


def stop_with_dump(
    run_dir: Path,
    what: str,
    *,
    recipe: Recipe,
    learner: Learner,
    env_steps: int,
    metrics: dict[str, float] | None = None,
) -> RunError:
    """Write the dump and return the error that says how to go on.

    Args:
        run_dir: run directory.
        what: what was not finite where it was noticed.
        recipe: of the run.
        learner: as the failing update left it.
        env_steps: of the run.
        metrics: newest record.
    """
    state = snapshot(learner.state_dict())
    # a learner may keep what its last update was fed with
    update = snapshot(getattr(learner, "last_update", None))
    cause = _cause(what, state, update)
    dump = {
        "format": FORMAT,
        "what": cause,
        "env_steps": env_steps,
        "updates": learner.updates,
        "recipe": dump_recipe(recipe),
        "learner": state,
        "update": update,
        "torch_rng": torch.get_rng_state(),
        "metrics": metrics or {},
    }
    where = f"The state and the batch are in {run_dir / DUMP}."
    try:
        with open_atomic(run_dir / DUMP) as file:
            torch.save(dump, file)
    except (OSError, RuntimeError) as error:
        where = f"The dump could not be written ({error})."
    return RunError(
        f"{run_dir}: not finite after {env_steps} env steps and {learner.updates} "
        f"updates: {cause}. {where} No checkpoint was written over; the newest good "
        f"one is {newest_checkpoint(run_dir)}. Go on from it with a smaller learning "
        f"rate, say: flashdex train --resume {run_dir} {_gentler(recipe)}. To repeat "
        "the update see 'NaN' in docs/runs.md."
    )


def _gentler(recipe: Recipe) -> str:
    """Overrides that halve the learning rate."""
    algo = recipe.algo
    if algo.kind == "ppo":
        return f"algo.ppo.lr={algo.ppo.lr / 2:g}"
    return f"algo.lr={algo.lr / 2:g} algo.lr_final={algo.lr_final / 2:g}"


def _cause(what: str, state: Any, update: Any) -> str:
    """The earliest thing that is not finite: batch, then weights, then ``what``."""
    for name, part in (("batch", (update or {}).get("batch")), ("state", state)):
        found = first_non_finite(part) if part is not None else ""
        if found:
            return f"{name} entry '{found}'" + (f", then {what}" if what else "")
    return what


def reopen(path: str | Path) -> tuple[Learner, Callable[[], TensorDictBase]]:
    """Build the learner of a dump and a function that repeats the failing update.

    Args:
        path: ``nan_dump.pt`` of a run whose motion library is still there.

    Returns:
        The learner as it was found, and a call without arguments that performs the
        update again under the guard: NonFiniteError, or the metrics.

    Raises:
        RunError: no such file, not a dump, or a learner that keeps no batch.

    Example:
        >>> learner, repeat = reopen("runs/a/nan_dump.pt")  # doctest: +SKIP
        >>> repeat()  # doctest: +SKIP
        flashdex.training.guard.NonFiniteError: gradient of parameter 0, (64, 218)
    """
    path = Path(path)
    dump = read_dump(path)
    from flashdex.training.build import open_workbench  # loads the simulator

    with TemporaryDirectory() as folder:
        file = Path(folder) / "recipe.yaml"
        file.write_text(dump["recipe"], encoding="utf-8")
        recipe = expect_kind(load_recipe(file), Recipe, where=str(path))
    bench = open_workbench(recipe)
    learner = bench.make_learner(bench.make_env())
    learner.load_state_dict(dump["learner"])
    update = dump["update"]
    redo = getattr(learner, "redo", None)
    if update is None or redo is None:
        raise RunError(f"{path}: holds no batch; this learner keeps none.")

    def repeat() -> TensorDictBase:
        torch.set_rng_state(dump["torch_rng"])
        with GradientGuard(waits=True), numeric_errors(learner):
            return redo(update)

    return learner, repeat


def read_dump(path: Path) -> dict[str, Any]:
    """Read a dump as plain data.

    Args:
        path: the file.
    """
    try:
        dump = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise RunError(f"{path}: not a readable dump ({error}).") from error
    check_format(dump, path)
    return dump
