"""Finds and checks the MANO model files, which every user has from their authors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side
from flashdex.motions.unpickle import load_npz, load_pickle

# below the folder that the user names, in this order
PLACES = (".", "models", "mano", "mano_v1_2/models")
NUM_VERTICES, NUM_JOINTS, NUM_BETAS = 778, 16, 10
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
SHAPES = {
    "v_template": (NUM_VERTICES, 3),
    "shapedirs": (NUM_VERTICES, 3, NUM_BETAS),
    "posedirs": (NUM_VERTICES, 3, 9 * (NUM_JOINTS - 1)),
    "J_regressor": (NUM_JOINTS, NUM_VERTICES),
    "weights": (NUM_VERTICES, NUM_JOINTS),
    "kintree_table": (2, NUM_JOINTS),
    "hands_mean": (45,),
    "hands_components": (45, 45),
}


@dataclass(frozen=True)
class ManoArrays:
    """What a MANO file holds; float64, metres.

    Args:
        template: vertices of the mean shape, flat open hand, (778, 3).
        shape_dirs: change of the vertices per shape coefficient, (778, 3, 10).
        pose_dirs: change of the vertices per element of R - 1, (778, 3, 135).
        regressor: joints from vertices, (16, 778).
        weights: of the vertices on the joints, (778, 16).
        mean: mean finger pose, axis-angle, (45,).
        components: principal components of finger poses, in rows, (45, 45).
    """

    template: np.ndarray
    shape_dirs: np.ndarray
    pose_dirs: np.ndarray
    regressor: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    components: np.ndarray


def mano_pair(folder: Path) -> tuple[Path, Path]:
    """The model files of both hands, left first.

    Raises:
        DemoError: one of them is missing.
    """
    left, right = (mano_file(folder, side) for side in SIDES)
    return left, right


def mano_file(folder: Path, side: Side) -> Path:
    """The model file of one hand.

    Args:
        folder: that the user names; ``models/``, ``mano/`` and ``mano_v1_2/models/``
            below it are searched as well.
        side: of the hand.

    Raises:
        DemoError: there is none; the message names every place.
    """
    names = [f"MANO_{side.upper()}{ending}" for ending in (".pkl", ".npz")]
    for place in PLACES:
        for name in names:
            if (folder / place / name).is_file():
                return folder / place / name
    places = ", ".join(str(folder / place) for place in PLACES)
    raise DemoError(
        f"E_MANO: no {names[0]} (or .npz) in {places}. Register at mano.is.tue.mpg.de, "
        f"unpack mano_v1_2.zip, and give its folder with --mano."
    )


def read_mano(file: Path, side: Side) -> ManoArrays:
    """The checked content of a model file.

    Raises:
        DemoError: the file cannot be read, lacks something, has another shape, or is
            of the other hand.
    """
    data = load_npz(file) if file.suffix == ".npz" else load_pickle(file)
    if not isinstance(data, dict):
        raise DemoError(f"E_MANO: {file} holds a {type(data).__name__}, not a model.")
    missing = sorted(set(SHAPES) - set(data))
    if missing:
        raise DemoError(
            f"E_MANO: {file} lacks {', '.join(missing)}. Expected a model of "
            f"mano_v1_2.zip; found {', '.join(sorted(map(str, data))[:12])}."
        )
    parts = {key: _array(file, key, data[key]) for key in SHAPES}
    _check_tree(file, parts["kintree_table"])
    arrays = ManoArrays(
        template=parts["v_template"],
        shape_dirs=parts["shapedirs"],
        pose_dirs=parts["posedirs"],
        regressor=parts["J_regressor"],
        weights=parts["weights"],
        mean=parts["hands_mean"],
        components=parts["hands_components"],
    )
    _check_side(file, side, arrays)
    return arrays


def _array(file: Path, key: str, value: Any) -> np.ndarray:
    """One part as a dense float64 array of the expected shape."""
    shape = tuple(getattr(value, "shape", ()))
    if shape != SHAPES[key]:
        raise DemoError(
            f"E_MANO: {file}: {key} has shape {shape}, expected {SHAPES[key]}. "
            f"MANO_LEFT and MANO_RIGHT of mano_v1_2.zip are read, no other model."
        )
    dense = value.toarray() if hasattr(value, "toarray") else value
    try:
        array = np.array(dense, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DemoError(f"E_MANO: {file}: {key} does not hold numbers.") from error
    if not np.isfinite(array).all():
        raise DemoError(f"E_MANO: {file}: {key} holds NaN or infinity.")
    array.setflags(write=False)  # one model serves all recordings of a worker
    return array


def _check_tree(file: Path, table: np.ndarray) -> None:
    # the root's parent is stored as an unsigned -1
    if tuple(table[0, 1:].astype(int)) != PARENTS[1:]:
        raise DemoError(
            f"E_MANO: {file}: kintree_table is not the tree of MANO: parents "
            f"{table[0, 1:].astype(int).tolist()}, expected {list(PARENTS[1:])}."
        )


def _check_side(file: Path, side: Side, arrays: ManoArrays) -> None:
    """The rest wrist of a right hand has positive x, of a left hand negative x."""
    x = float(arrays.regressor[0] @ arrays.template[:, 0])
    if (x > 0) != (side == "right"):
        other = "left" if side == "right" else "right"
        raise DemoError(
            f"E_MANO: {file} is a {other} hand (rest wrist at x = {x:.3f} m) under the "
            f"name of a {side} one. The two files are swapped; unpack them anew."
        )
