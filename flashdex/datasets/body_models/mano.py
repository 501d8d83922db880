"""MANO hand model: 21 keypoints from joint rotations, shape and translation.

Our own layer from the published formulas (linear blend skinning); the model files come
from the user. Rotations enter as matrices, so axis-angle, principal components and
quaternions share one path. Only what the keypoints need is skinned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.pickles import load_npz, load_pickle
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

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


__all__ = ["ManoModel", "load_mano", "mano_file"]

# "joint": the rest wrist joint is added to the translation (smplx); "wrist": the
# translation is where the wrist is (manotorch with center_idx = 0)
Convention = Literal["joint", "wrist"]

# vertices at the fingertips, thumb to pinky: those of manopth, for every dataset
TIP_VERTICES: dict[Side, tuple[int, ...]] = {
    "left": (745, 317, 445, 556, 673),
    "right": (745, 317, 444, 556, 673),
}
# the 21 keypoints among the 16 joints (pinky before ring) and the 5 tips
FINGER_ROWS = (13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)
# shapedirs of the left hand that differ less than this from the right hand's in x, m,
# summed, have the wrong sign (github.com/vchoutas/smplx/issues/48)
SAME_SHAPE_DIRS = 1.0


@dataclass(frozen=True)
class ManoModel:
    """One hand of MANO.

    Args:
        side: of the hand.
        arrays: of its file.
        left_shape_fixed: whether the sign error of the left shape was corrected.

    Example:
        >>> model = load_mano(Path("~/mano").expanduser(), "right")  # doctest: +SKIP
        >>> flat = np.zeros((1, 48))
        >>> model.keypoints(
        ...     rotations_from_axis_angle(flat),
        ...     np.zeros(10),
        ...     np.zeros((1, 3)),
        ...     convention="wrist",
        ... ).shape  # doctest: +SKIP
        (1, 21, 3)
    """

    side: Side
    arrays: ManoArrays
    left_shape_fixed: bool = False

    def keypoints(
        self,
        rotations: np.ndarray,
        betas: np.ndarray | None,
        translation: np.ndarray,
        *,
        convention: Convention,
        template: np.ndarray | None = None,
    ) -> np.ndarray:
        """Keypoints of every frame.

        Args:
            rotations: of the wrist in the world and of the joints in their parents,
                flat hand = identity, (T, 16, 3, 3); NaN where not tracked.
            betas: shape, (10,); None for the mean shape.
            translation: m, (T, 3).
            convention: where the translation puts the wrist.
            template: vertices in place of the model's own, m, (778, 3).

        Returns:
            m, world, (T, 21, 3); NaN in every frame with a NaN.

        Raises:
            DemoError: an array has another shape.
        """
        tips = list(TIP_VERTICES[self.side])
        joints, vertices = self._pose(
            rotations, betas, translation, convention, template, tips
        )
        return np.concatenate([joints, vertices], axis=1)[:, [0, *FINGER_ROWS]]

    def vertices(
        self,
        rotations: np.ndarray,
        betas: np.ndarray | None,
        translation: np.ndarray,
        *,
        convention: Convention,
        template: np.ndarray | None = None,
    ) -> np.ndarray:
        """The whole skin, m, (T, 778, 3); arguments as in ``keypoints``."""
        rows = list(range(NUM_VERTICES))
        return self._pose(rotations, betas, translation, convention, template, rows)[1]

    def rest_wrist(
        self, betas: np.ndarray | None = None, template: np.ndarray | None = None
    ) -> np.ndarray:
        """Where the wrist joint is at rest, m, (3,): what "joint" adds."""
        return self.arrays.regressor[0] @ self._shape(betas, template)

    def finger_pose(self, coefficients: np.ndarray, *, flat: bool) -> np.ndarray:
        """Axis-angle of the fingers from principal components.

        Args:
            coefficients: of the first n components, (T, n).
            flat: zero coefficients are the flat hand, not the mean pose.

        Returns:
            rad, (T, 45).

        Raises:
            DemoError: there are more than 45 coefficients, or not one row a frame.
        """
        if coefficients.ndim != 2 or coefficients.shape[1] > 45:
            raise DemoError(
                f"MANO coefficients have shape {coefficients.shape}, expected (T, n) "
                f"with n <= 45."
            )
        pose = coefficients @ self.arrays.components[: coefficients.shape[1]]
        return pose if flat else self.add_mean(pose)

    def add_mean(self, pose: np.ndarray) -> np.ndarray:
        """Axis-angle of the fingers (T, 45) from one relative to the mean pose."""
        return pose + self.arrays.mean

    def _shape(
        self, betas: np.ndarray | None, template: np.ndarray | None
    ) -> np.ndarray:
        """Vertices at rest, (778, 3)."""
        base = self.arrays.template if template is None else np.asarray(template)
        _check_shape("template", base, (NUM_VERTICES, 3))
        if betas is None:
            return base
        betas = np.asarray(betas, dtype=np.float64)
        _check_shape("betas", betas, (NUM_BETAS,))
        return base + self.arrays.shape_dirs @ betas

    def _pose(
        self,
        rotations: np.ndarray,
        betas: np.ndarray | None,
        translation: np.ndarray,
        convention: Convention,
        template: np.ndarray | None,
        rows: list[int],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joints (T, 16, 3) and vertices ``rows`` (T, len(rows), 3) in the world."""
        frames = len(rotations)
        _check_shape("rotations", rotations, (frames, NUM_JOINTS, 3, 3))
        _check_shape("translation", translation, (frames, 3))
        shaped = self._shape(betas, template)
        rest = self.arrays.regressor @ shaped
        seen = np.isfinite(rotations.reshape(frames, -1)).all(axis=1)
        seen &= np.isfinite(translation).all(axis=1)
        turns, joints = _chain(rotations[seen], rest)
        skin = self._skin(rotations[seen], turns, joints, shaped, rest, rows)
        shift = translation[seen]
        if convention == "wrist":
            shift = shift - joints[:, 0]
        out = np.full((frames, NUM_JOINTS + len(rows), 3), np.nan)
        out[seen] = np.concatenate([joints, skin], axis=1) + shift[:, None]
        return out[:, :NUM_JOINTS], out[:, NUM_JOINTS:]

    def _skin(
        self,
        rotations: np.ndarray,
        turns: np.ndarray,
        joints: np.ndarray,
        shaped: np.ndarray,
        rest: np.ndarray,
        rows: list[int],
    ) -> np.ndarray:
        """Vertices ``rows`` carried by the joints, before the translation."""
        feature = (rotations[:, 1:] - np.eye(3)).reshape(-1, 9 * (NUM_JOINTS - 1))
        bent = self.arrays.pose_dirs[rows].reshape(-1, feature.shape[1])
        skin = shaped[rows] + (feature @ bent.T).reshape(len(feature), len(rows), 3)
        vertices = np.zeros_like(skin)
        for joint in range(NUM_JOINTS):
            moved = (skin - rest[joint]) @ turns[:, joint].swapaxes(1, 2)
            moved += joints[:, joint, None]
            vertices += self.arrays.weights[rows, joint, None] * moved
        return vertices


def _chain(rotations: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, 16, 3, 3) and positions (T, 16, 3) down the tree."""
    turns = np.empty_like(rotations, dtype=np.float64)
    joints = np.empty((*rotations.shape[:2], 3))
    turns[:, 0], joints[:, 0] = rotations[:, 0], rest[0]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        turns[:, joint] = turns[:, parent] @ rotations[:, joint]
        bone = rest[joint] - rest[parent]
        joints[:, joint] = joints[:, parent] + turns[:, parent] @ bone
    return turns, joints


@lru_cache(maxsize=8)
def load_mano(folder: Path, side: Side, *, fix_left_shape: bool = False) -> ManoModel:
    """The model of one hand; kept for the next call.

    Args:
        folder: with the model files, or one above them (see ``mano_file``).
        side: of the hand.
        fix_left_shape: correct the sign error of the released left hand's shape, if
            this file has it. Only for datasets that were fitted that way.

    Raises:
        DemoError: E_MANO: a file is missing, damaged, or not this hand.
    """
    arrays = read_mano(mano_file(folder, side), side)
    if not fix_left_shape or side == "right":
        return ManoModel(side, arrays)
    right = read_mano(mano_file(folder, "right"), "right")
    gap = np.abs(arrays.shape_dirs[:, 0] - right.shape_dirs[:, 0]).sum()
    if gap >= SAME_SHAPE_DIRS:
        return ManoModel(side, arrays)
    mirrored = arrays.shape_dirs * np.array([-1.0, 1.0, 1.0])[:, None]
    return ManoModel(side, replace(arrays, shape_dirs=mirrored), True)


def rotations_from_axis_angle(pose: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 16, 3, 3) of axis-angle poses (T, 48), rad; NaN to NaN."""
    vectors = np.asarray(pose, dtype=np.float64).reshape(len(pose), NUM_JOINTS, 3)
    seen = np.isfinite(vectors).all(axis=(1, 2))
    out = np.full((len(pose), NUM_JOINTS, 3, 3), np.nan)
    turns = Rotation.from_rotvec(vectors[seen].reshape(-1, 3)).as_matrix()
    out[seen] = turns.reshape(-1, NUM_JOINTS, 3, 3)
    return out


def rotations_from_quats(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 16, 3, 3) of quaternions (T, 16, 4), wxyz.

    They need not be unit; a frame with NaN or a quaternion of length zero becomes NaN.
    """
    quats = np.asarray(quats, dtype=np.float64)
    _check_shape("quaternions", quats, (len(quats), NUM_JOINTS, 4))
    norms = np.linalg.norm(quats, axis=-1)
    seen = (np.isfinite(norms) & (norms > 1e-6)).all(axis=1)
    out = np.full((len(quats), NUM_JOINTS, 3, 3), np.nan)
    flat = quats[seen].reshape(-1, 4)
    turns = Rotation.from_quat(flat, scalar_first=True).as_matrix()
    out[seen] = turns.reshape(-1, NUM_JOINTS, 3, 3)
    return out


def _check_shape(what: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise DemoError(f"MANO {what} have shape {array.shape}, expected {shape}.")
