"""Numbers that are not finite: found before they spread, and dumped to be repeated."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer
from torch.optim.optimizer import register_optimizer_step_pre_hook

from flashdex.algorithms.base import Learner, snapshot
from flashdex.errors import RunError
from flashdex.recipe import dump_recipe
from flashdex.system.run_files import DUMP
from flashdex.system.tensors import first_non_finite, read_tensors, write_tensors
from flashdex.training.checkpoint import FORMAT, check_format, newest_checkpoint


class NonFiniteError(Exception):
    """A gradient, loss or weight is NaN or infinite."""


@contextmanager
def numeric_errors(learner: Learner) -> Iterator[None]:
    """Tell a RuntimeError that stems from NaN from other ones.

    The projection of a target indexes with what the networks say, and fails on NaN
    before there is any gradient.

    Raises:
        NonFiniteError: an error came up, and its batch or its state is not finite.
    """
    try:
        yield
    except RuntimeError as error:
        if first_non_finite([learner.last_update, learner.state_dict()]):
            raise NonFiniteError(str(error).splitlines()[0]) from error
        raise


class GradientGuard:
    """Looks at the gradients before every optimiser step inside the ``with`` block.

    On a CPU a gradient that is not finite raises before the step, so the weights are
    those before it. On a GPU nothing waits for the device: fused optimisers skip the
    step there by themselves, and ``check`` raises when it is next called.
    ``waits=True`` raises at once there, too; False never does.
    """

    def __init__(self, *, waits: bool | None = None) -> None:
        self.waits = waits
        self._flag: Tensor | None = None

    def __enter__(self) -> GradientGuard:
        self._handle = register_optimizer_step_pre_hook(self._look)
        return self

    def __exit__(self, *error: object) -> None:
        self._handle.remove()

    @torch.no_grad()
    def _look(self, optimizer: Optimizer, args: Any, kwargs: Any) -> None:
        parameters = [p for g in optimizer.param_groups for p in g["params"]]
        grads = [p.grad for p in parameters if p.grad is not None]
        if not grads:
            return
        # finite only if every entry is
        total = get_total_norm(grads)
        waits = total.device.type == "cpu" if self.waits is None else self.waits
        if waits:
            if not bool(total.isfinite()):
                raise NonFiniteError(_describe(parameters))
            return
        bad = (~total.isfinite()).float()
        if optimizer.param_groups[0].get("fused"):
            optimizer.found_inf = bad  # type: ignore[attr-defined]
        self._flag = bad if self._flag is None else torch.maximum(self._flag, bad)

    def check(self) -> None:
        """Raise if a step was skipped since the beginning; waits for the device."""
        if self._flag is not None and bool(self._flag):
            msg = "gradient (the step was skipped on the device)"
            raise NonFiniteError(msg)


def _describe(parameters: list[Tensor]) -> str:
    for number, p in enumerate(parameters):
        if p.grad is not None and not bool(p.grad.isfinite().all()):
            return f"gradient of parameter {number}, {tuple(p.shape)}"
    return "norm of the gradients"


def stop_with_dump(
    run_dir: Path,
    what: str,
    *,
    recipe: Any,
    learner: Learner,
    env_steps: int,
    metrics: dict[str, float] | None = None,
) -> RunError:
    """Write ``nan_dump.pt`` and return the error that says how to go on."""
    state = snapshot(learner.state_dict())
    update = snapshot(learner.last_update)
    cause = _cause(what, state, update)
    dump = {
        "format": FORMAT,
        "sealed": True,
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
        write_tensors(dump, run_dir, DUMP)
    except (OSError, RunError) as error:
        where = f"The dump could not be written ({error})."
    return RunError(
        f"{run_dir}: not finite after {env_steps} env steps and {learner.updates} "
        f"updates: {cause}. {where} No checkpoint was written over; the newest good "
        f"one is {newest_checkpoint(run_dir)}. Go on from it with a smaller learning "
        f"rate, say: flashdex train --resume {run_dir} "
        f"{learner.gentler(recipe.algo)}. To repeat the update see 'NaN' in "
        "docs/runs.md."
    )


def _cause(what: str, state: Any, update: Any) -> str:
    """The earliest thing that is not finite: batch, then weights, then ``what``."""
    for name, part in (("batch", (update or {}).get("batch")), ("state", state)):
        found = first_non_finite(part) if part is not None else ""
        if found:
            return f"{name} entry '{found}'" + (f", then {what}" if what else "")
    return what


def read_dump(path: Path) -> dict[str, Any]:
    """Read a dump as plain data.

    Raises:
        RunError: it is damaged, of another version, or no dump.
    """
    try:
        dump = read_tensors(path.parent, path.name)
    except ValueError as error:
        raise RunError(f"{path}: not a readable dump ({error}).") from error
    check_format(dump, path, ("what", "recipe", "learner", "update", "torch_rng"))
    return dump
