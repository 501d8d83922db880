"""One sequence of TACO: its files, and what is read from them.

MANO with the flat hand; ``hand_trans`` is the wrist. Meshes are centimetres, poses
metres. The origin lies somewhere below the table, so no height is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.body_models.mano import load_mano
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fields import numbers, part, poses_from_matrices, to_array
from flashdex.datasets.files import load_pickle, refuse_pointer, told
from flashdex.datasets.roots import relative, scaled_mesh
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

NUM_POSE, NUM_BETAS = 48, 10
FPS = 30.0
HANDS, OBJECTS = "Hand_Poses", "Object_Poses"
ROLES = ("tool", "target")
MESH_SCALE = 0.01  # centimetres to metres
MAX_TRIM = 2  # frames by which tracks of a sequence may differ in length
LICENCE = "TACO, CC BY 4.0"


@dataclass(frozen=True, kw_only=True)
class TacoSequence:
    """Where one sequence lies."""

    root: Path
    folder: str
    name: str
    split: str
    meshes: dict[str, Path]
    mano: Path

    @property
    def words(self) -> list[str]:
        """Verb, tool, target."""
        return self.folder.split("/")[0].strip("()").split(", ")

    def hand_files(self, side: Side) -> list[Path]:
        """One file of all frames, or one a frame in an older layout; in time order."""
        folder = self.root / HANDS / self.folder
        whole = folder / f"{side}_hand.pkl"
        each = sorted((folder / f"{side}_hand").glob("hand_*.pkl"))
        return [whole] if whole.is_file() else each

    def shape_file(self, side: Side) -> Path:
        """The hand's shape; it may be missing."""
        return self.root / HANDS / self.folder / f"{side}_hand_shape.pkl"

    def pose_files(self, role: str) -> list[Path]:
        """``<role>_<id>.npy``; one is expected."""
        return sorted((self.root / OBJECTS / self.folder).glob(f"{role}_*.npy"))

    def files(self) -> list[Path]:
        """Every file of the dataset that the sequence depends on and that exists."""
        files = [file for side in SIDES for file in self.hand_files(side)]
        files += [f for side in SIDES if (f := self.shape_file(side)).is_file()]
        files += [file for role in ROLES for file in self.pose_files(role)]
        return [*files, *self.meshes.values()]


def mesh_id(pose_file: Path) -> str:
    """The id in ``tool_<id>.npy``."""
    return pose_file.stem.partition("_")[2]


def read_sequence(sequence: TacoSequence) -> list[HumanDemo]:
    """One sequence as one motion."""
    for file in sequence.files():
        refuse_pointer(file)
    notes: list[str] = []
    hands: dict[Side, np.ndarray] = {
        side: _read_hand(sequence, side, notes) for side in SIDES
    }
    objects = [_read_object(sequence, role, notes) for role in ROLES]
    frames = _common_length(sequence, hands, objects, notes)
    keypoints: dict[Side, np.ndarray] = {s: k[:frames] for s, k in hands.items()}
    demo = HumanDemo(
        name=sequence.name,
        fps=FPS,
        keypoints=keypoints,
        objects=[DemoObject(b.name, b.mesh, b.pose[:frames]) for b in objects],
        source="taco",
        licence=LICENCE,
        split=sequence.split,
        task=", ".join(sequence.words),
        provenance={
            "files": [relative(file, sequence.root) for file in sequence.files()],
            "fps": FPS,
            "frames": [0, frames],
            "roles": {r: b.name for r, b in zip(ROLES, objects, strict=True)},
            "notes": notes,
        },
    )
    return [demo]


def _read_hand(sequence: TacoSequence, side: Side, notes: list[str]) -> np.ndarray:
    """Keypoints, m, (T, 21, 3)."""
    files = sequence.hand_files(side)
    if not files:
        raise DemoError(
            f"{sequence.root / HANDS / sequence.folder}: no {side} hand. "
            f"Expected {side}_hand.pkl, or {side}_hand/hand_*.pkl.",
            code="E_FILE",
        )
    shape_file = sequence.shape_file(side)
    if not shape_file.is_file():
        notes.append(f"W_SHAPE: no {shape_file.name}; the mean shape is used")
    betas = np.zeros(NUM_BETAS)
    if shape_file.is_file():
        stored = part(load_pickle(shape_file), "hand_shape", where=str(shape_file))
        betas = to_array(stored, NUM_BETAS, what=f"{shape_file}: hand_shape")
    if files[0].parent.name == f"{side}_hand":  # one file a frame
        frames = [(str(file), load_pickle(file)) for file in files]
    else:
        frames = _all_frames(files[0])
    table = np.stack([_frame_row(frame, where=where) for where, frame in frames])
    return load_mano(sequence.mano, side).keypoints_of(
        table[:, :3],
        table[:, 3:NUM_POSE],
        table[:, NUM_POSE:],
        betas=betas,
        convention="wrist",
        where=str(files[0]),
    )


def _all_frames(file: Path) -> list[tuple[str, Any]]:
    """Frames of a file that holds all, with their place; their keys sort in time."""
    frames = load_pickle(file)
    if not isinstance(frames, dict) or not frames:
        raise DemoError(
            f"{file}: holds a {type(frames).__name__}; expected a dict of frames, each "
            f"with hand_pose and hand_trans.",
            code="E_KEYS",
        )
    keys = sorted(frames, key=_frame_order)
    return [(f"{file}, frame {key!r}", frames[key]) for key in keys]


def _frame_order(key: object) -> tuple[int, str]:
    """Time order of frame keys, with or without leading zeros."""
    text = str(key)
    return (int(text) if text.isdecimal() and len(text) < 20 else -1, text)


def _frame_row(frame: Any, *, where: str) -> np.ndarray:
    """Axis-angle, rad, then wrist position, m, (51,)."""
    sizes = {"hand_pose": NUM_POSE, "hand_trans": 3}
    return np.concatenate(
        [
            to_array(part(frame, key, where=where), size, what=f"{where}: {key}")
            for key, size in sizes.items()
        ]
    )


def _read_object(sequence: TacoSequence, role: str, notes: list[str]) -> DemoObject:
    files = sequence.pose_files(role)
    if len(files) != 1:
        raise DemoError(
            f"{sequence.root / OBJECTS / sequence.folder}: {len(files)} files "
            f"{role}_<id>.npy; expected one.",
            code="E_FILE",
        )
    file, key = files[0], mesh_id(files[0])
    if key not in sequence.meshes:
        raise DemoError(
            f"{file}: no mesh {key}_cm.obj in Object_Models. Download it, or "
            f"name the folder of the meshes with --models.",
            code="E_FILE",
        )
    pose, found = poses_from_matrices(_load_matrices(file), what=str(file))
    notes += found
    category = sequence.words[1 + ROLES.index(role)].replace(" ", "_")
    mesh = scaled_mesh(sequence.meshes[key], MESH_SCALE)
    return DemoObject(f"{category}_{key}", mesh, pose)


def _load_matrices(file: Path) -> np.ndarray:
    fault = "not a .npy of (T, 4, 4) floats; pickled arrays are not read"
    with told(file, fault, code="E_KEYS"):
        return numbers(np.load(file, allow_pickle=False), what=f"{file}: (T, 4, 4)")


def _common_length(
    sequence: TacoSequence,
    keypoints: dict[Side, np.ndarray],
    objects: list[DemoObject],
    notes: list[str],
) -> int:
    """Frames that all tracks have; they may differ by two at the end."""
    lengths = {f"{side} hand": len(track) for side, track in keypoints.items()}
    lengths |= {r: len(b.pose) for r, b in zip(ROLES, objects, strict=True)}
    shortest, longest = min(lengths.values()), max(lengths.values())
    counts = ", ".join(f"{name} {count}" for name, count in lengths.items())
    if longest - shortest > MAX_TRIM:
        raise DemoError(
            f"{sequence.folder}: frames differ: {counts}. At most {MAX_TRIM} "
            f"may be missing at the end. Download the sequence again.",
            code="E_LEN",
        )
    if longest > shortest:
        notes.append(f"E_LEN: trimmed to {shortest} frames: {counts}")
    return shortest
