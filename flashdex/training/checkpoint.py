"""Checkpoints: atomic, rotated, read back without unpickling foreign code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.files import open_atomic

FOLDER = "checkpoints"


def save_checkpoint(run_dir: Path, state: dict[str, Any], *, keep: int) -> Path:
    """Write ``checkpoints/<env_steps>.pt`` in one piece and drop the oldest.

    Args:
        run_dir: run directory.
        state: tensors and plain Python values only.
        keep: newest checkpoints that stay.
    """
    folder = run_dir / FOLDER
    path = folder / f"{state['env_steps']:012d}.pt"
    with open_atomic(path) as file:
        torch.save(state, file)
    for old in sorted(folder.glob("*.pt"))[:-keep]:
        old.unlink()
    return path


def load_checkpoint(run_dir: Path) -> dict[str, Any]:
    """Read the newest checkpoint of a run.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    found = sorted((run_dir / FOLDER).glob("*.pt"))
    if not found:
        raise RunError(
            f"{run_dir}: no checkpoint in '{FOLDER}/'. A run writes one every "
            "train.checkpoint_every_s seconds and when it is stopped."
        )
    try:
        return torch.load(found[-1], map_location="cpu", weights_only=True)
    except Exception as error:
        raise RunError(
            f"{found[-1]}: cannot be read ({error}). Delete it to fall back to the "
            "one before."
        ) from error
