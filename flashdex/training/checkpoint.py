"""Checkpoints: atomic, rotated, read back without unpickling foreign code."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.replay.disk import FOLDER, ReplayLog
from flashdex.system.files import open_atomic

_LOG = logging.getLogger(__name__)
FORMAT = 2  # raised whenever older code could misread a checkpoint
EVALUATED = ("env_steps", "learner", "recipe")
RESUMED = (
    *EVALUATED,
    "vector_steps",
    "wall_s",
    "assist",
    "assist_epoch",
    "env_generator",
    "torch_rng",
    "ledger_bytes",
    "wandb_id",
)


def save_checkpoint(
    run_dir: Path,
    state: dict[str, Any],
    *,
    keep: int,
    replay: ReplayLog | None = None,
) -> Path:
    """Write ``checkpoints/<env_steps>.pt`` in one piece; the ``keep`` newest stay.

    Replay rows are on the disk before the checkpoint that needs them, and go after the
    last one that does: a crash in between leaves the former pair usable.

    Raises:
        OSError: the disk is full, say; the former checkpoints are as they were.
    """
    path = run_dir / FOLDER / f"{checkpoint_name(state['env_steps'])}.pt"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        if replay is not None:
            replay.save(path.stem)
        with open_atomic(path) as file:
            torch.save({"format": FORMAT, **state}, file)
    except RuntimeError as error:
        # torch's writer reports a failed write as a RuntimeError of its own
        raise OSError(f"{path}: {error}") from error
    finally:
        for old in _newest_first(run_dir)[keep:]:
            old.unlink()
        if replay is not None:
            replay.prune(checkpoint_names(run_dir))
    return path


def load_checkpoint(
    run_dir: Path, needs: Collection[str] = ("env_steps",)
) -> dict[str, Any]:
    """Read the newest checkpoint that can be read; a warning names those that cannot.

    Raises:
        RunError: there is none, none can be read, another version wrote it, or a key
            is missing.
    """
    found = _newest_first(run_dir)
    if not found:
        raise RunError(
            f"{run_dir}: no checkpoint in '{FOLDER}/'. A run writes one every "
            "train.checkpoint_every_s seconds and when it is stopped."
        )
    faults = []
    for path in found:
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            what = (str(error).strip() or type(error).__name__).splitlines()[0]
            faults.append(f"{path.name}: {what}")
            _LOG.warning("%s cannot be read, trying the one before", path)
            continue
        check_format(state, path, needs)
        return state
    raise RunError(
        f"{run_dir / FOLDER}: no checkpoint can be read ({'; '.join(faults)}). Restore "
        "one from a copy, or start a new run; stored conversions are not affected."
    )


def check_format(state: Any, path: Path, needs: Collection[str] = ()) -> None:
    """Refuse a checkpoint of another version, or one without what is needed.

    Raises:
        RunError: the format is another one, or a key is missing.
    """
    found = state.get("format", 0) if isinstance(state, dict) else None
    if found != FORMAT:
        raise RunError(
            f"{path}: checkpoint format {found}, this version reads {FORMAT}. Go on "
            "with the flashdex that wrote it (versions.json in the run), or start anew."
        )
    if missing := [key for key in needs if key not in state]:
        raise RunError(
            f"{path}: not a whole checkpoint, it lacks {', '.join(missing)}. Move it "
            "away to go on from the one before, or start a new run."
        )


def checkpoint_name(env_steps: int) -> str:
    """Stem of the files of a checkpoint."""
    return f"{env_steps:012d}"


def checkpoint_names(run_dir: Path) -> set[str]:
    """Stems of all checkpoints of a run."""
    return {path.stem for path in _newest_first(run_dir)}


def has_checkpoint(run_dir: Path) -> bool:
    """Whether the run wrote any checkpoint, readable or not."""
    return bool(_newest_first(run_dir))


def newest_checkpoint(run_dir: Path) -> str:
    """Name of the newest checkpoint for messages, ``none`` without one."""
    found = _newest_first(run_dir)
    return f"{FOLDER}/{found[0].name}" if found else "none"


def set_aside_newer(run_dir: Path, env_steps: int) -> None:
    """Rename what lies beyond the checkpoint that a run goes on from.

    Only unreadable ones do. Under their name they would be tried first at every resume
    and rotate good ones out.
    """
    for path in _newest_first(run_dir):
        if int(path.stem) > env_steps:
            path.replace(path.with_suffix(".unreadable"))


def remove_temporaries(run_dir: Path) -> None:
    """Delete the half-written files that a killed run left behind."""
    for path in run_dir.rglob(".*.tmp"):
        path.unlink(missing_ok=True)


def _newest_first(run_dir: Path) -> list[Path]:
    found = (run_dir / FOLDER).glob("*.pt")
    return sorted((p for p in found if p.stem.isdigit()), reverse=True)
