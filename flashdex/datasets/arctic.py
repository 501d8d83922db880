"""Reads ARCTIC: both hands and one object of two hinged parts, 30 Hz, z up.

``raw_seqs/s01 ... s10/<object>_{grab,use}_<NN>.mano.npy`` holds per hand ``rot``
(T, 3), ``pose`` (T, 45), ``trans`` (T, 3) in metres and ``shape`` (10,): MANO with the
mean pose, translation of the rest wrist. ``....object.npy`` is (T, 7): angle of the
hinge, rad, axis-angle, and a translation in **millimetres**. The meshes
``meta/object_vtemplates/<object>/{top,bottom}.obj`` are in millimetres too. The top
turns about the -z axis of the object frame before the object is placed; the parts
become two rigid bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import load_mano, mano_pair
from flashdex.datasets.demo import MAX_SECONDS, DemoObject, HumanDemo
from flashdex.datasets.fields import part, pose_track, same_length, to_array, track
from flashdex.datasets.files import load_npy, read_json, refuse_clone, told
from flashdex.datasets.roots import (
    listed,
    on_disk,
    relative,
    require_folders,
    require_mesh,
    scaled_mesh,
)
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.tracks import missing_frames
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

FPS = 30.0
SEQUENCES, TEMPLATES = "raw_seqs", "meta/object_vtemplates"
SPLIT_LIST = "splits_json/protocol_p1.json"
MILLIMETRE = 1e-3
HINGE = np.array([0.0, 0.0, -1.0])  # through the origin of the object frame
PARTS = ("top", "bottom")
JOINT = {"child": 0, "parent": 1, "axis": HINGE.tolist(), "anchor": [0.0, 0.0, 0.0]}


@dataclass(frozen=True, kw_only=True)
class ArcticSequence:
    """Where one sequence lies."""

    root: Path
    name: str  # <subject>/<object>_<action>_<NN>
    meshes: Path
    mano: Path
    split: str = ""  # of the dataset's protocol, if known

    @property
    def words(self) -> list[str]:
        """Object and action."""
        return Path(self.name).name.split("_")[:2]

    def file(self, kind: str) -> Path:
        """``<name>.<kind>.npy``; kinds are mano and object."""
        return on_disk(self.root / SEQUENCES / f"{self.name}.{kind}.npy")

    def files(self) -> list[Path]:
        """Every file of the dataset that it depends on and that exists."""
        meshes = [on_disk(self.meshes / f"{part}.obj") for part in PARTS]
        files = [self.file("mano"), self.file("object"), *meshes]
        return [file for file in files if file.is_file()]


def list_arctic(options: SourceOptions) -> list[Recording]:
    """All sequences, in name order."""
    root, mano = options.folder("path"), options.folder("mano")
    folders = (SEQUENCES,) if options.models else (SEQUENCES, TEMPLATES)
    require_folders(root, folders, dataset="ARCTIC")
    models = mano_pair(mano)
    splits = _read_splits(options.splits or root / SPLIT_LIST, given=options.splits)
    recordings = []
    for file in listed(root / SEQUENCES, "*/*.mano.npy"):
        name = f"{file.parent.name}/{file.name[: -len('.mano.npy')]}"
        sequence = ArcticSequence(
            root=root,
            name=name,
            meshes=(options.models or root / TEMPLATES) / file.name.split("_")[0],
            mano=mano,
            split=splits.get(name, ""),
        )
        recordings.append(
            Recording(
                name=name.replace("/", "_"),
                read=partial(read_sequence, sequence),
                files=(*sequence.files(), *models),
                key=sequence.split,
            )
        )
    if not recordings:
        raise DemoError(
            f"{root / SEQUENCES}: no <subject>/<object>_<action>_<NN>.mano.npy. "
            f"Unpack raw_seqs.zip there.",
            code="E_ROOT",
        )
    refuse_clone(recordings[0].files[:1])
    return recordings


def read_sequence(sequence: ArcticSequence) -> list[HumanDemo]:
    """One sequence as one motion."""
    hands = load_npy(sequence.file("mano"))
    keypoints: dict[Side, np.ndarray] = {
        s: _read_hand(sequence, hands, s) for s in SIDES
    }
    bodies = _read_objects(sequence)
    lengths = {f"{side} hand": len(track) for side, track in keypoints.items()}
    lengths["object"] = len(bodies[0].pose)
    frames = same_length(lengths, where=sequence.name)
    return [
        HumanDemo(
            name=sequence.name.replace("/", "_"),
            fps=FPS,
            keypoints=keypoints,
            objects=bodies,
            source=SOURCE.name,
            licence=SOURCE.licence,
            needs_cutting=frames / FPS > MAX_SECONDS,
            split=sequence.split,
            task=" ".join(sequence.words),
            provenance={
                "files": [relative(f, sequence.root) for f in sequence.files()],
                "fps": FPS,
                "frames": [0, frames],
                "joint": JOINT,
                "parts": "two rigid bodies; the hinge is not kept",
            },
        )
    ]


def _read_hand(sequence: ArcticSequence, hands: object, side: Side) -> np.ndarray:
    file = str(sequence.file("mano"))
    hand, where = part(hands, side, where=file), f"{file}: {side} hand"
    model = load_mano(sequence.mano, side)
    return model.keypoints_of(
        track(hand, "rot", 3, where=where),
        model.add_mean(track(hand, "pose", 45, where=where)),
        track(hand, "trans", 3, where=where),
        betas=to_array(part(hand, "shape", where=where), 10, what=f"{where}: shape"),
        convention="joint",
        where=where,
    )


def _read_objects(sequence: ArcticSequence) -> list[DemoObject]:
    """The top, turned about the hinge, and the bottom."""
    file = sequence.file("object")
    stored = track({"array": load_npy(file)}, "array", 7, where=str(file))
    seen = ~missing_frames(stored)
    turns = Rotation.from_rotvec(stored[seen, 1:4])
    place = stored[:, 4:] * MILLIMETRE
    opened = turns * Rotation.from_rotvec(stored[seen, :1] * HINGE)
    bodies = []
    for name, turn in zip(PARTS, (opened, turns), strict=True):
        hint = "Unpack meta.zip, or name the folder of object_vtemplates"
        mesh = require_mesh(sequence.meshes / f"{name}.obj", hint)
        body = scaled_mesh(mesh, MILLIMETRE)
        pose = pose_track(turn, place, seen)
        bodies.append(DemoObject(f"{sequence.words[0]}_{name}", body, pose))
    return bodies


def _read_splits(file: Path, *, given: Path | None) -> dict[str, str]:
    if given is None and not file.is_file():
        return {}
    fault = (
        "not a JSON object of splits, each a list of <subject>/<sequence>, as in "
        "splits_json/protocol_p1.json"
    )
    with told(file, fault):
        protocol = read_json(file, fault)
        return {str(n): str(s) for s, names in protocol.items() for n in names}


SOURCE = Source(
    name="arctic",
    list=list_arctic,
    about="ARCTIC: raw_seqs and meta/object_vtemplates; needs MANO",
    licence="ARCTIC: non-commercial research, no redistribution",
    needs=("path", "mano"),
)
