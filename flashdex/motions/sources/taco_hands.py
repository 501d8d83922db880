"""Hands of TACO: MANO parameters from its pickles, one of all frames or one a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import DemoError
from flashdex.motions.sources.rigid import to_array
from flashdex.motions.unpickle import load_pickle

NUM_POSE, NUM_BETAS = 48, 10


def read_all_frames(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of a file that holds all frames, by keys that sort in time.

    Returns:
        Axis-angle, rad, (T, 48), and wrist position, m, (T, 3).

    Raises:
        DemoError: the pickle is refused, or a frame lacks something.
    """
    frames = load_pickle(file)
    if not isinstance(frames, dict) or not frames:
        raise DemoError(
            f"{file}: E_KEYS: holds a {type(frames).__name__}; expected a dict of "
            f"frames, each with hand_pose and hand_trans."
        )
    keys = sorted(frames, key=_frame_order)
    return _stack([(f"{file}, frame {key!r}", frames[key]) for key in keys])


def read_frame_files(files: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """As ``read_all_frames``, from one file a frame, in time order."""
    return _stack([(str(file), load_pickle(file)) for file in files])


def read_shape(file: Path) -> np.ndarray:
    """Shape of a hand, (10,).

    Raises:
        DemoError: the pickle is refused, or holds something else.
    """
    shape = load_pickle(file)
    if not isinstance(shape, dict) or "hand_shape" not in shape:
        raise DemoError(f"{file}: E_KEYS: expected a dict with hand_shape (10,).")
    return to_array(shape["hand_shape"], NUM_BETAS, what=f"{file}: hand_shape")


def _frame_order(key: object) -> tuple[int, str]:
    """Time order of frame keys, with or without leading zeros."""
    text = str(key)
    return (int(text) if text.isdecimal() and len(text) < 20 else -1, text)


def _stack(frames: list[tuple[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    for where, frame in frames:
        if not isinstance(frame, dict) or not {"hand_pose", "hand_trans"} <= set(frame):
            raise DemoError(
                f"{where}: E_KEYS: expected a dict with hand_pose (48,) and hand_trans "
                f"(3,)."
            )
        pose = to_array(frame["hand_pose"], NUM_POSE, what=f"{where}: hand_pose")
        wrist = to_array(frame["hand_trans"], 3, what=f"{where}: hand_trans")
        rows.append(np.concatenate([pose, wrist]))
    table = np.stack(rows)
    return table[:, :NUM_POSE], table[:, NUM_POSE:]
