"""Checkpoints: atomic, rotated, read back without unpickling foreign code."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from flashdex.errors import RunError
from flashdex.replay.disk import ReplayLog
from flashdex.system.files import own_file, own_files, own_folder, remove_own
from flashdex.system.run_files import CHECKPOINTS as FOLDER
from flashdex.system.run_files import FOLDERS
from flashdex.system.tensors import first_non_finite, read_tensors, write_tensors

_LOG = logging.getLogger(__name__)
FORMAT = 3  # raised whenever older code could misread a checkpoint
READ = (2, FORMAT)  # those before 3 have no seal
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
TYPES: dict[str, tuple[type, ...]] = {
    "env_steps": (int,),
    "vector_steps": (int,),
    "env_steps_lost": (int,),
    "records": (int,),
    "ledger_bytes": (int,),
    "wall_s": (float, int),
    "learner": (dict,),
    "update": (dict, type(None)),  # of a dump
    "recipe": (str,),
    "run": (str,),
    "wandb_id": (str, type(None)),
    "assist": (dict, type(None)),
    "assist_epoch": (dict,),
    "env_generator": (torch.Tensor,),
    "torch_rng": (torch.Tensor,),
}


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
    path = own_folder(run_dir, FOLDER) / f"{checkpoint_name(state['env_steps'])}.pt"
    try:
        if replay is not None:
            replay.save(path.stem)
        content = {"format": FORMAT, "sealed": True, **state}
        write_tensors(content, run_dir, FOLDER, path.name)
    finally:
        for old in checkpoint_files(run_dir)[keep:]:
            remove_own(run_dir, FOLDER, old.name)
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
    found = checkpoint_files(run_dir)
    if not found:
        raise RunError(
            f"{run_dir}: no checkpoint in '{FOLDER}/'. A run writes one every "
            "train.checkpoint_every_s seconds and when it is stopped."
        )
    faults = []
    for path in found:
        try:
            state = read_checkpoint(run_dir, path.name)
        except ValueError as error:
            faults.append(f"{path.name}: {error}")
            _LOG.warning("%s cannot be used (%s), trying the one before", path, error)
            continue
        check_format(state, path, needs)
        return state
    raise RunError(
        f"{run_dir / FOLDER}: no checkpoint can be read ({'; '.join(faults)}). Restore "
        "one from a copy, or start a new run; stored conversions are not affected."
    )


def read_checkpoint(run_dir: Path, name: str) -> Any:
    """What a checkpoint holds; the learner in it is finite.

    Raises:
        ValueError: it is damaged, or not finite.
    """
    state = read_tensors(run_dir, FOLDER, name)
    learner = state.get("learner") if isinstance(state, dict) else None
    if bad := first_non_finite(learner):
        raise ValueError(f"its '{bad}' is not finite")
    return state


def check_format(state: Any, path: Path, needs: Collection[str] = ()) -> None:
    """Refuse a checkpoint of another version, or one without what is needed.

    Raises:
        RunError: the format is another one, or a key is missing.
    """
    found = state.get("format", 0) if isinstance(state, dict) else None
    if found not in READ:
        raise RunError(
            f"{path}: checkpoint format {found}, this version reads {FORMAT}. Go on "
            "with the flashdex that wrote it (versions.json in the run), or start anew."
        )
    if missing := [key for key in needs if key not in state]:
        raise RunError(
            f"{path}: not a whole checkpoint, it lacks {', '.join(missing)}. Move it "
            "away to go on from the one before, or start a new run."
        )
    for key, kinds in TYPES.items():
        value = state.get(key)
        is_odd = isinstance(value, bool) or not isinstance(value, kinds)
        if key in state and (is_odd or (isinstance(value, int) and value < 0)):
            raise RunError(
                f"{path}: not a checkpoint of flashdex, '{key}' is {value!r:.40}. Move "
                "it away to go on from the one before, or start a new run."
            )


def checkpoint_name(env_steps: int) -> str:
    """Stem of the files of a checkpoint."""
    return f"{env_steps:012d}"


def checkpoint_names(run_dir: Path) -> set[str]:
    """Stems of all checkpoints of a run."""
    return {path.stem for path in checkpoint_files(run_dir)}


def has_checkpoint(run_dir: Path) -> bool:
    """Whether the run wrote any checkpoint, readable or not."""
    return bool(checkpoint_files(run_dir))


def newest_checkpoint(run_dir: Path) -> str:
    """Name of the newest checkpoint for messages, ``none`` without one."""
    found = checkpoint_files(run_dir)
    return f"{FOLDER}/{found[0].name}" if found else "none"


def set_aside_newer(run_dir: Path, env_steps: int) -> None:
    """Rename what lies beyond the checkpoint that a run goes on from.

    Only unreadable ones do. Under their name they would be tried first at every resume
    and rotate good ones out.
    """
    for path in checkpoint_files(run_dir):
        if int(path.stem) > env_steps:
            os.replace(path, own_file(run_dir, FOLDER, f"{path.stem}.unreadable"))


def checkpoint_files(run_dir: Path) -> list[Path]:
    """All checkpoints of a run, the newest first."""
    found = own_files(run_dir, FOLDER, "[0-9]*.pt")
    names = [p for p in found if FOLDERS[FOLDER].fullmatch(p.name)]
    return sorted(names, reverse=True)
