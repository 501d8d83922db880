"""MANO hand model: 21 keypoints from joint rotations, shape and translation.

Our own layer from the published formulas (linear blend skinning); the model files come
from the user. Rotations enter as matrices, so axis-angle, principal components and
quaternions share one path. Only what the keypoints need is skinned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.fields import same_length
from flashdex.datasets.files import load_npz, load_pickle
from flashdex.datasets.roots import on_disk
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.errors import DemoError
from flashdex.keys import Side

# below the folder that the user names, in this order
PLACES = (".", "models", "mano", "mano_v1_2/models")
NUM_VERTICES, NUM_JOINTS, NUM_BETAS = 778, 16, 10
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
KINTREE = "kintree_table"
# parts of ``ManoArrays``: their key and shape in a file
PARTS: dict[str, tuple[str, tuple[int, ...]]] = {
    "template": ("v_template", (NUM_VERTICES, 3)),
    "shape_dirs": ("shapedirs", (NUM_VERTICES, 3, NUM_BETAS)),
    "pose_dirs": ("posedirs", (NUM_VERTICES, 3, 9 * (NUM_JOINTS - 1))),
    "regressor": ("J_regressor", (NUM_JOINTS, NUM_VERTICES)),
    "weights": ("weights", (NUM_VERTICES, NUM_JOINTS)),
    "mean": ("hands_mean", (45,)),
    "components": ("hands_components", (45, 45)),
}
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
class ManoArrays:
    """What a MANO file holds; float64, metres."""

    template: np.ndarray  # vertices of the mean shape, flat open hand, (778, 3)
    shape_dirs: np.ndarray  # their change per shape coefficient, (778, 3, 10)
    pose_dirs: np.ndarray  # their change per element of R - 1, (778, 3, 135)
    regressor: np.ndarray  # joints from vertices, (16, 778)
    weights: np.ndarray  # of the vertices on the joints, (778, 16)
    mean: np.ndarray  # mean finger pose, axis-angle, (45,)
    components: np.ndarray  # principal components of finger poses, in rows, (45, 45)


def mano_pair(folder: Path) -> tuple[Path, Path]:
    """The model files of both hands, left first."""
    return mano_file(folder, "left"), mano_file(folder, "right")


def mano_file(folder: Path, side: Side) -> Path:
    """The model file of one hand, in a folder or in ``PLACES`` below it."""
    names = [f"MANO_{side.upper()}{ending}" for ending in (".pkl", ".npz")]
    for place in PLACES:
        for name in names:
            if (file := on_disk(folder / place / name)).is_file():
                return file
    places = ", ".join(str(folder / place) for place in PLACES)
    raise DemoError(
        f"no {names[0]} (or .npz) in {places}. Register at mano.is.tue.mpg.de, "
        f"unpack mano_v1_2.zip, and give its folder with --mano.",
        code="E_MANO",
    )


def read_mano(file: Path, side: Side) -> ManoArrays:
    """The checked content of a model file."""
    data = load_npz(file) if file.suffix.lower() == ".npz" else load_pickle(file)
    if not isinstance(data, dict):
        raise _wrong(file, f"it holds a {type(data).__name__}, not a model.")
    missing = sorted({KINTREE, *(key for key, _ in PARTS.values())} - set(data))
    if missing:
        raise _wrong(
            file,
            f"it lacks {', '.join(missing)}. Expected a model of mano_v1_2.zip; found "
            f"{', '.join(sorted(map(str, data))[:12])}.",
        )
    parents = _array(file, KINTREE, data[KINTREE], (2, NUM_JOINTS))[0, 1:].astype(int)
    if tuple(parents) != PARENTS[1:]:  # the root's is stored as an unsigned -1
        raise _wrong(
            file,
            f"kintree_table is not the tree of MANO: parents {parents.tolist()}, "
            f"expected {list(PARENTS[1:])}.",
        )
    arrays = ManoArrays(
        **{n: _array(file, key, data[key], shape) for n, (key, shape) in PARTS.items()}
    )
    # the rest wrist of a right hand has positive x, of a left hand negative x
    x = float(arrays.regressor[0] @ arrays.template[:, 0])
    if (x > 0) != (side == "right"):
        other = "left" if side == "right" else "right"
        raise _wrong(
            file,
            f"it is a {other} hand (rest wrist at x = {x:.3f} m) under the name of a "
            f"{side} one. The two files are swapped; unpack them anew.",
        )
    return arrays


def _array(file: Path, key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    found = tuple(getattr(value, "shape", ()))
    if found != shape:
        raise _wrong(
            file,
            f"{key} has shape {found}, expected {shape}. MANO_LEFT and MANO_RIGHT of "
            f"mano_v1_2.zip are read, no other model.",
        )
    try:
        dense = value.toarray() if hasattr(value, "toarray") else value
        array = np.array(dense, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _wrong(file, f"{key} does not hold numbers.") from error
    if not np.isfinite(array).all():
        raise _wrong(file, f"{key} holds NaN or infinity.")
    array.setflags(write=False)  # one model serves all recordings of a worker
    return array


def _wrong(file: Path, text: str) -> DemoError:
    return DemoError(f"{file}: {text}", code="E_MANO")


@dataclass(frozen=True)
class ManoModel:
    """One hand of MANO."""

    side: Side  # of the hand
    arrays: ManoArrays  # of its file
    left_shape_fixed: bool = False  # whether its sign error was corrected

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
        """
        shaped, tips = self.shape(betas, template), list(TIP_VERTICES[self.side])
        points = self.pose(rotations, shaped, translation, tips, convention=convention)
        return points[:, [0, *FINGER_ROWS]]

    def keypoints_of(
        self,
        wrist: np.ndarray,
        fingers: np.ndarray,
        translation: np.ndarray,
        *,
        betas: np.ndarray | None,
        convention: Convention,
        where: str,
        template: np.ndarray | None = None,
    ) -> np.ndarray:
        """As ``keypoints``, of axis-angle poses: wrist (T, 3), fingers (T, 45), rad."""
        counts = {"turn": len(wrist), "fingers": len(fingers)}
        same_length(counts | {"transl": len(translation)}, where=where)
        turns = rotations_from_axis_angle(np.concatenate([wrist, fingers], axis=1))
        return self.keypoints(
            turns, betas, translation, convention=convention, template=template
        )

    def rest_wrist(
        self, betas: np.ndarray | None = None, template: np.ndarray | None = None
    ) -> np.ndarray:
        """Where the wrist joint is at rest, m, (3,): what "joint" adds."""
        return self.arrays.regressor[0] @ self.shape(betas, template)

    def finger_pose(self, coefficients: np.ndarray, *, flat: bool) -> np.ndarray:
        """Axis-angle of the fingers, rad, (T, 45), from principal components (T, n).

        With ``flat`` zero coefficients are the flat hand, else the mean pose.
        """
        if coefficients.ndim != 2 or coefficients.shape[1] > 45:
            shape = coefficients.shape
            raise DemoError(f"MANO coefficients {shape}, expected (T, n), n <= 45.")
        pose = coefficients @ self.arrays.components[: coefficients.shape[1]]
        return pose if flat else self.add_mean(pose)

    def add_mean(self, pose: np.ndarray) -> np.ndarray:
        """Axis-angle of the fingers (T, 45) from one relative to the mean pose."""
        return pose + self.arrays.mean

    def shape(
        self, betas: np.ndarray | None = None, template: np.ndarray | None = None
    ) -> np.ndarray:
        """Vertices at rest, m, (778, 3)."""
        base = self.arrays.template if template is None else np.asarray(template)
        _check_shape("template", base, (NUM_VERTICES, 3))
        if betas is None:
            return base
        betas = np.asarray(betas, dtype=np.float64)
        _check_shape("betas", betas, (NUM_BETAS,))
        return base + self.arrays.shape_dirs @ betas

    def pose(
        self,
        rotations: np.ndarray,
        shaped: np.ndarray,
        translation: np.ndarray,
        rows: list[int],
        *,
        convention: Convention,
    ) -> np.ndarray:
        """The 16 joints, then the vertices ``rows``, m, world, (T, 16 + rows, 3).

        ``shaped`` are the vertices at rest, m, (778, 3); see ``keypoints``.
        """
        frames = len(rotations)
        _check_shape("rotations", rotations, (frames, NUM_JOINTS, 3, 3))
        _check_shape("translation", translation, (frames, 3))
        rest = self.arrays.regressor @ shaped
        seen = ~missing_frames(rotations, translation)
        turns, joints = _chain(rotations[seen], rest)
        # what the pose does to the skin, before the joints carry it
        feature = rotations[seen, 1:] - np.eye(3)
        feature = feature.reshape(-1, 9 * (NUM_JOINTS - 1))
        bent = self.arrays.pose_dirs[rows].reshape(-1, feature.shape[1])
        skin = shaped[rows] + (feature @ bent.T).reshape(len(feature), len(rows), 3)
        vertices = np.zeros_like(skin)
        for joint in range(NUM_JOINTS):
            moved = (skin - rest[joint]) @ turns[:, joint].swapaxes(1, 2)
            moved += joints[:, joint, None]
            vertices += self.arrays.weights[rows, joint, None] * moved
        shift = translation[seen]
        if convention == "wrist":
            shift = shift - joints[:, 0]
        out = np.full((frames, NUM_JOINTS + len(rows), 3), np.nan)
        out[seen] = np.concatenate([joints, vertices], axis=1) + shift[:, None]
        return out


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

    ``fix_left_shape`` corrects the sign error of the released left hand's shape, if
    this file has it; only for datasets that were fitted that way.
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
    return _matrices(vectors, Rotation.from_rotvec, ~missing_frames(vectors))


def rotations_from_quats(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 16, 3, 3) of quaternions (T, 16, 4), wxyz.

    They need not be unit; a frame with NaN or a quaternion of length zero becomes NaN.
    """
    quats = np.asarray(quats, dtype=np.float64)
    _check_shape("quaternions", quats, (len(quats), NUM_JOINTS, 4))
    norms = np.linalg.norm(quats, axis=-1)
    seen = (np.isfinite(norms) & (norms > 1e-6)).all(axis=1)
    return _matrices(quats, rotation, seen)


def _matrices(
    given: np.ndarray, make: Callable[[np.ndarray], Rotation], seen: np.ndarray
) -> np.ndarray:
    out = np.full((len(given), NUM_JOINTS, 3, 3), np.nan)
    turns = make(given[seen].reshape(-1, given.shape[-1])).as_matrix()
    out[seen] = turns.reshape(-1, NUM_JOINTS, 3, 3)
    return out


def _check_shape(what: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise DemoError(f"MANO {what} have shape {array.shape}, expected {shape}.")
