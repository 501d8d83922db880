"""Reads TACO: a tool, a target and both hands, 30 frames a second, z up.

``Hand_Poses/(verb, tool, target)/<sequence>/`` holds ``<side>_hand.pkl`` (older: a
folder ``<side>_hand`` of one file a frame) and ``<side>_hand_shape.pkl``;
``Object_Poses/(verb, tool, target)/<sequence>/`` holds ``tool_<id>.npy`` and
``target_<id>.npy``, (T, 4, 4), m; ``Object_Models/<id>_cm.obj`` are the meshes.

MANO with the flat hand; ``hand_trans`` is the wrist. Meshes are centimetres, poses
metres. The origin lies somewhere below the table, so no height is claimed.
"""

from __future__ import annotations

import io
import logging
import re
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.body_models.mano import load_mano, mano_pair
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fields import numbers, part, poses_from_matrices, row, to_array
from flashdex.datasets.files import (
    load_pickle,
    read_bytes,
    read_text,
    refuse_clone,
    refuse_pointer,
    told,
)
from flashdex.datasets.roots import listed, relative, require_folders, scaled_mesh
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side
from flashdex.system.archives import read_array

NUM_POSE, NUM_BETAS = 48, 10
FRAME = {"hand_pose": NUM_POSE, "hand_trans": 3}  # axis-angle, rad; wrist position, m
FPS = 30.0
HANDS, OBJECTS = "Hand_Poses", "Object_Poses"
ROLES = ("tool", "target")
MESH_SCALE = 0.01  # centimetres to metres
MAX_TRACK = 1 << 28  # bytes of a track; an hour has 14 million
MAX_TRIM = 2  # frames by which tracks of a sequence may differ in length


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
        each = listed(folder / f"{side}_hand", "hand_*.pkl")
        return [whole] if whole.is_file() else each

    def shape_file(self, side: Side) -> Path:
        """The hand's shape; it may be missing."""
        return self.root / HANDS / self.folder / f"{side}_hand_shape.pkl"

    def pose_files(self, role: str) -> list[Path]:
        """``<role>_<id>.npy``; one is expected."""
        return listed(self.root / OBJECTS / self.folder, f"{role}_*.npy")

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
        source=SOURCE.name,
        licence="TACO, CC BY 4.0",
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
    table = np.stack([row(frame, FRAME, where=where) for where, frame in frames])
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
    text = str(key)
    return (int(text) if text.isdecimal() and len(text) < 20 else -1, text)


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
        data = read_bytes(file, most=MAX_TRACK)
        stored = read_array(io.BytesIO(data), len(data))
        return numbers(stored, what=f"{file}: (T, 4, 4)")


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


MESH_FOLDERS = (
    "Object_Models",
    "Object_Models/object_models_released",
    "object_models_released",
)
MESH_SUFFIX = "_cm.obj"
TRIPLET = re.compile(r"\([^,]+, [^,]+, [^)]+\)")
SPLIT_LINE = re.compile(r"(\d{8}_\d+),(\w+)")
SPLIT_LIST = "v1_overall_data_train_test_split.txt"

logger = logging.getLogger(__name__)


def list_taco(options: SourceOptions) -> list[Recording]:
    """All sequences that have hands or objects, in name order."""
    root, mano = options.folder("path"), options.folder("mano")
    require_folders(root, (HANDS, OBJECTS), dataset="TACO")
    meshes = _find_meshes(root, options.models)
    models = mano_pair(mano)
    folders = sorted({*_folders(root / HANDS), *_folders(root / OBJECTS)})
    splits = _read_splits(options.splits, folders) if options.splits else {}
    recordings = []
    for folder, name in zip(folders, _unique_names(folders), strict=True):
        split = splits.get(Path(folder).name, "")
        whole = TacoSequence(
            root=root, folder=folder, name=name, split=split, meshes=meshes, mano=mano
        )
        recordings.append(_recording(whole, models))
    # an unfetched repository consists of pointers only
    refuse_clone(recordings[0].files if recordings else ())
    return recordings


def _recording(whole: TacoSequence, models: tuple[Path, ...]) -> Recording:
    ids = [mesh_id(file) for role in ROLES for file in whole.pose_files(role)]
    # only the meshes it uses: a recording goes to another process
    used = {key: whole.meshes[key] for key in ids if key in whole.meshes}
    sequence = replace(whole, meshes=used)
    return Recording(
        name=sequence.name,
        read=partial(read_sequence, sequence),
        files=(*sequence.files(), *models),
        key=f"{sequence.folder} {sequence.split}",
    )


def _find_meshes(root: Path, extra: Path | None) -> dict[str, Path]:
    places = [root / folder for folder in MESH_FOLDERS]
    places = places if extra is None else [extra, *places]
    found: dict[str, Path] = {}
    for place in places:
        for file in listed(place, f"*{MESH_SUFFIX}"):
            found.setdefault(file.name[: -len(MESH_SUFFIX)], file)
    if not found:
        sought = ", ".join(str(place) for place in places)
        raise DemoError(
            f"{root}: no meshes <id>{MESH_SUFFIX}. Sought in {sought}. "
            f"Download Object_Models, or name its folder with --models.",
            code="E_ROOT",
        )
    return found


def _folders(root: Path) -> list[str]:
    """``(verb, tool, target)/<sequence>`` of all sequences below a folder."""
    found = []
    for triplet in (entry for entry in listed(root, "*") if entry.is_dir()):
        if not TRIPLET.fullmatch(triplet.name):
            logger.warning("%s: not '(verb, tool, target)'; left out", triplet)
            continue
        found += [
            f"{triplet.name}/{entry.name}"
            for entry in listed(triplet, "*")
            if entry.is_dir()
        ]
    return found


def _unique_names(folders: list[str]) -> list[str]:
    """Names of the sequences; the triplet is added where two share a name."""
    counts = Counter(Path(folder).name for folder in folders)
    names = []
    for folder in folders:
        triplet, sequence = folder.split("/")
        words = re.sub(r"[^\w-]+", "_", triplet).strip("_")
        names.append(sequence if counts[sequence] == 1 else f"{sequence}_{words}")
    return names


def _read_splits(file: Path, folders: list[str]) -> dict[str, str]:
    with told(file, "not a readable list of splits"):
        lines = read_text(file).split()
    matches = [SPLIT_LINE.fullmatch(line) for line in lines]
    splits = {match[1]: match[2] for match in matches if match}
    known = {Path(folder).name for folder in folders}
    if None in matches or not known & set(splits):
        fault = lines[matches.index(None)] if None in matches else "no sequence in use"
        raise DemoError(
            f"{file}: expected lines 'sequence,split' as in TACO's {SPLIT_LIST}, like "
            f"'20231104_017,train'; found {fault!r}."
        )
    return splits


SOURCE = Source(
    name="taco",
    list=list_taco,
    about="TACO: Hand_Poses, Object_Poses and Object_Models of bimanual tool use",
    licence="CC BY 4.0; MANO under its own licence (non-commercial research)",
    needs=("path", "mano"),
)
