"""Reads HOT3D: egocentric recordings of two hands and the objects of a table.

A root is a folder of sequences (``P0003_c701bd11``), one sequence, or a folder that
holds them in ``train``, ``test``, ``hot3d_dataset``, ``Aria`` or ``Quest3``. A sequence
is a session of many actions with all objects of the room; later steps cut it and keep
the objects that are touched.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.body_models.mano import mano_pair
from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.files import refuse_clone
from flashdex.datasets.hot3d.files import (
    FPS,
    FrameAxis,
    Mask,
    frame_axis,
    read_mask,
    read_poses,
)
from flashdex.datasets.hot3d.hands import read_keypoints
from flashdex.datasets.hot3d.world import (
    INSTANCES,
    TEST_PARTICIPANTS,
    ObjectLibrary,
    find_library,
    read_metadata,
    read_objects,
    refuse_without_truth,
    up_axis,
)
from flashdex.datasets.roots import listed, relative, shown
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError

OBJECTS_FILE = "dynamic_objects.csv"
HEADSET_FILE = "headset_trajectory.csv"
METADATA_FILE = "metadata.json"
GROUPS = ("hot3d_dataset", "train", "test", "Aria", "Quest3")
SEQUENCE = re.compile(r"P\d{4}_[0-9a-f]{8}")
# Which masks forbid what: hands, objects; and whether every stream must allow a frame.
# The two that say "available" forbid nothing: one hand or one object that is missing
# makes them false, and what is missing has no row anyway.
MASKS: dict[str, tuple[bool, bool, bool]] = {
    "hand_pose_available": (False, False, False),
    "object_pose_available": (False, False, False),
    "object_pose_quality": (False, True, True),
    "qa_pass": (True, True, True),
}
HEAD_BYTES = 65536  # of the object poses that are looked at when listing


def list_hot3d(options: SourceOptions) -> list[Recording]:
    """Sequences of a root, in name order."""
    root = options.folder("path")
    folders = _find_sequences(root)
    if not folders:
        raise DemoError(_wrong_root(root), code="E_ROOT")
    refuse_clone([folders[0] / OBJECTS_FILE])
    library = find_library(root, options.models)
    mano = options.mano
    models = () if mano is None else mano_pair(mano)
    return [
        Recording(
            name=folder.name,
            read=partial(read_sequence, folder, root, library, mano),
            files=(*_sequence_files(folder), *_library_files(folder, library), *models),
            key=f"{folder.parent.name} {library.key()}",  # the split is a folder
        )
        for folder in folders
    ]


def _find_sequences(root: Path) -> list[Path]:
    if _is_sequence(root):
        return [root]
    groups = [root, *(root / name for name in GROUPS)]
    groups += [root / GROUPS[0] / name for name in GROUPS[1:]]
    found = {
        folder.name: folder
        for group in groups
        if group.is_dir()
        for folder in listed(group, "*")
        if _is_sequence(folder)
    }
    return [found[name] for name in sorted(found)]


def _is_sequence(folder: Path) -> bool:
    """By its content; the name alone is enough where poses were not published."""
    if not folder.is_dir():
        return False
    if (folder / OBJECTS_FILE).is_file():
        return True
    is_named = SEQUENCE.fullmatch(folder.name) is not None
    return is_named and (folder / METADATA_FILE).is_file()


def _wrong_root(root: Path) -> str:
    sought = f"{OBJECTS_FILE} in it, in P####_*/, or in those of {', '.join(GROUPS)}"
    if not root.exists():
        return f"{root}: no such folder. Expected a folder of HOT3D sequences."
    hint = "Give the folder of the sequences, or one sequence."
    if (root.parent / OBJECTS_FILE).is_file():
        hint = f"This is a part of a sequence: give {root.parent}."
    elif deeper := next(root.glob(f"*/*/*/{OBJECTS_FILE}"), None) or next(
        root.glob(f"*/*/{OBJECTS_FILE}"), None
    ):
        hint = f"Sequences lie deeper: give {deeper.parents[1]}."
    elif next(root.glob("*.zip"), None):
        hint = "Unpack the .zip files first."
    return f"{root}: no HOT3D sequence. Sought {sought}. Found {shown(root)}. {hint}"


def _sequence_files(folder: Path) -> tuple[Path, ...]:
    names = [OBJECTS_FILE, HEADSET_FILE, METADATA_FILE]
    hands = listed(folder, "*_hand_*.json*")
    masks = [_mask_file(folder, name) for name in MASKS]
    files = [*(folder / name for name in names), *hands, *masks]
    return tuple(file for file in files if file.is_file())


def _library_files(folder: Path, library: ObjectLibrary) -> tuple[Path, ...]:
    """Models that the head of the poses names (all objects are there from the start).

    A model that only a later line names is in ``ObjectLibrary.key``.
    """
    files = [library.folder / INSTANCES]
    poses = folder / OBJECTS_FILE
    if poses.is_file():
        with poses.open(encoding="utf-8", errors="replace") as stream:
            lines = stream.read(HEAD_BYTES).splitlines()[1:]
        uids = dict.fromkeys(line.split(",")[0] for line in lines)
        files += [library.mesh(uid) for uid in uids if uid.isdecimal()]
    return tuple(file for file in files if file.is_file())


def read_sequence(
    folder: Path, root: Path, library: ObjectLibrary, mano: Path | None
) -> list[HumanDemo]:
    """One sequence, uncut, at 30 fps; without MANO models by UmeTrack keypoints."""
    metadata = read_metadata(folder / METADATA_FILE)
    refuse_without_truth(folder, metadata, "umetrack" if mano is None else "mano")
    tracks = read_poses(folder / OBJECTS_FILE)
    masks = {name: read_mask(_mask_file(folder, name)) for name in MASKS}
    axis = frame_axis(folder.name, tracks.values(), masks["object_pose_available"])
    hands_allowed, objects_allowed, notes = _apply_masks(axis, masks)
    objects, found = read_objects(
        folder.name, tracks, axis, objects_allowed, library, metadata.names
    )
    places = [track.values[:, :3] for track in tracks.values()]
    up, measured = up_axis(folder.name, metadata.headset, _headset(folder), places)
    keypoints, decided = read_keypoints(folder, axis, mano, allowed=hands_allowed)
    return [
        HumanDemo(
            name=folder.name,
            fps=FPS,
            keypoints=keypoints,
            objects=objects,
            source=SOURCE.name,
            licence=SOURCE.licence,
            up=up,
            needs_cutting=True,
            split=_split(folder, metadata.participant),
            provenance={
                "files": [relative(folder, root) if folder != root else folder.name],
                "headset": metadata.headset,
                "participant": metadata.participant,
                **({"version": metadata.version} if metadata.version else {}),
                "fps": round(axis.fps, 3),
                "stamps": axis.rule,
                "unrecorded_frames": int((~axis.recorded).sum()),
                **(notes | measured | decided | found),
            },
        )
    ]


def _apply_masks(
    axis: FrameAxis, masks: dict[str, Mask | None]
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Frames with valid hands (T,) and objects (T,); how many each mask forbids."""
    allowed = np.ones((2, len(axis.times)), dtype=bool)
    refused: dict[str, int] = {}
    for name, (hands, objects, every) in MASKS.items():
        frames = axis.allowed(masks[name], every_stream=every)
        allowed[np.array([hands, objects])] &= frames
        if not frames.all():
            refused[name] = int((~frames).sum())
    absent = [name for name in MASKS if masks[name] is None]
    return allowed[0], allowed[1], {"masked_frames": refused, "absent_masks": absent}


def _headset(folder: Path) -> np.ndarray:
    file = folder / HEADSET_FILE
    tracks = list(read_poses(file).values()) if file.is_file() else []
    return np.concatenate([t.values[:, :3] for t in tracks] or [np.zeros((0, 3))])


def _mask_file(folder: Path, name: str) -> Path:
    return folder / "masks" / f"mask_{name}.csv"


def _split(folder: Path, participant: str) -> str:
    if folder.parent.name in ("train", "test"):
        return folder.parent.name
    return "test" if participant in TEST_PARTICIPANTS else "train"


SOURCE = Source(
    name="hot3d",
    list=list_hot3d,
    about="HOT3D sequences (ground truth and hand data; --models: its object "
    "library, --mano: MANO models, else UmeTrack keypoints)",
    licence="HOT3D licence agreement (projectaria.com); no redistribution",
)
