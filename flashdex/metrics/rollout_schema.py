"""Format of stored rollouts: version, shapes and the checks that name a fault."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flashdex.errors import RunError

ROLLOUT_SCHEMA = 1

# shape symbols: T control steps, O object slots, M joints of joint_error, H = 2 hands
SHAPES: dict[str, str] = {
    "qpos0": "nq",
    "qvel0": "nv",
    "ctrl": "T nu",
    "qpos": "T nq",
    "qvel": "T nv",
    "object_pos": "T O 3",
    "object_quat": "T O 4",
    "ref_object_pos": "T O 3",
    "ref_object_quat": "T O 4",
    "fingertips": "T 2 5 3",
    "ref_fingertips": "T 2 5 3",
    "joints": "T 2 M 3",
    "ref_joints": "T 2 M 3",
    "hand_active": "2",
    "hand_object": "2",
    "object_qpos_adr": "O",
    "object_qvel_adr": "O",
    "actions": "T 2 A",
    "wrist_pos": "T 2 3",
    "ref_wrist_pos": "T 2 3",
    "act0": "na",
    "wrench": "T O 6",
}


def check_schema(data: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Refuse files of another format or version.

    Args:
        data: arrays of the file.
        path: file name for the message.
    """
    if "schema" not in data:
        raise RunError(f"{path}: missing key schema; this is not a flashdex rollout.")
    if int(data["schema"]) != ROLLOUT_SCHEMA:
        raise RunError(
            f"{path}: schema {int(data['schema'])}, this version reads "
            f"{ROLLOUT_SCHEMA}. Store the rollout again or use the matching version."
        )


def check_shape(
    key: str, value: np.ndarray, symbols: str, sizes: dict[str, int], where: str
) -> None:
    """Compare a shape with its symbols; a symbol keeps the size it first had.

    Args:
        key: name of the array.
        value: the array.
        symbols: e.g. ``T 2 5 3``.
        sizes: sizes seen so far; new symbols are added.
        where: file name for the message.
    """
    names = symbols.split()
    fits = value.ndim == len(names) and all(
        size == (int(name) if name.isdigit() else sizes.setdefault(name, size))
        for name, size in zip(names, value.shape, strict=True)
    )
    if not fits:
        known = ", ".join(f"{n}={sizes[n]}" for n in names if n in sizes)
        raise RunError(
            f"{where}: {key} has shape {value.shape}, expected ({symbols})"
            f"{' with ' + known if known else ''}. Store the rollout again."
        )


def check_json(key: str, text: str, where: str) -> None:
    """Refuse a field that is not JSON; ``wrist_bodies`` may be empty.

    Args:
        key: name of the field.
        text: its content.
        where: file name for the message.
    """
    if not text and key == "wrist_bodies":
        return
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        raise RunError(f"{where}: {key} is not JSON ({error}).") from error
