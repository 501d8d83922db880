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

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import (
    load_mano,
    mano_pair,
    rotations_from_axis_angle,
)
from flashdex.datasets.demo import MAX_SECONDS, DemoObject, HumanDemo
from flashdex.datasets.fields import part, pose_track, same_length, to_array, track
from flashdex.datasets.pickles import load_object_array
from flashdex.datasets.roots import refuse_clone, relative, require_folders, scaled_mesh
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.tracks import missing_frames, palm_frame
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

FPS = 30.0
SEQUENCES, TEMPLATES = "raw_seqs", "meta/object_vtemplates"
SPLIT_LIST = "splits_json/protocol_p1.json"
MILLIMETRE = 1e-3
HINGE = np.array([0.0, 0.0, -1.0])  # through the origin of the object frame
PARTS = ("top", "bottom")


@dataclass(frozen=True, kw_only=True)
class ArcticSequence:
    """Where one sequence lies.

    Attributes:
        root: of the dataset.
        name: ``<subject>/<object>_<action>_<NN>``.
        meshes: folder of the object's meshes.
        mano: folder of the hand model.
        split: of the dataset's protocol, if known.
    """

    root: Path
    name: str
    meshes: Path
    mano: Path
    split: str = ""

    @property
    def object(self) -> str:
        """The object's name."""
        return Path(self.name).name.split("_")[0]

    def file(self, kind: str) -> Path:
        """``<name>.<kind>.npy``; kinds are mano and object."""
        return self.root / SEQUENCES / f"{self.name}.{kind}.npy"

    def files(self) -> list[Path]:
        """Every file of the dataset that it depends on and that exists."""
        meshes = [self.meshes / f"{part}.obj" for part in PARTS]
        files = [self.file("mano"), self.file("object"), *meshes]
        return [file for file in files if file.is_file()]


def list_arctic(options: SourceOptions) -> list[Recording]:
    """All sequences, in name order.

    Raises:
        DemoError: the root is not ARCTIC's, or MANO or the split list is at fault.
    """
    root, mano = options.path, options.mano
    assert root is not None  # ``Source.needs``
    assert mano is not None
    folders = (SEQUENCES,) if options.models else (SEQUENCES, TEMPLATES)
    require_folders(root, folders, dataset="ARCTIC")
    models = mano_pair(mano)
    splits = _read_splits(options.splits or root / SPLIT_LIST, given=options.splits)
    recordings = []
    for file in sorted((root / SEQUENCES).glob("*/*.mano.npy")):
        name = f"{file.parent.name}/{file.name.removesuffix('.mano.npy')}"
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
            f"{root / SEQUENCES}: no <subject>/<object>_<action>_<NN>.mano.npy "
            f"(E_ROOT). Unpack raw_seqs.zip there."
        )
    refuse_clone(recordings[0].files[:1])
    return recordings


def read_sequence(sequence: ArcticSequence) -> list[HumanDemo]:
    """One sequence as one motion.

    Raises:
        DemoError: a file is missing or wrong, or tracks differ in length.
    """
    hands = load_object_array(sequence.file("mano"))
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
            palm={side: palm_frame(track, side) for side, track in keypoints.items()},
            objects=bodies,
            source="arctic",
            licence=ARCTIC.licence,
            needs_cutting=frames / FPS > MAX_SECONDS,
            split=sequence.split,
            task=" ".join(Path(sequence.name).name.split("_")[:2]),
            provenance={
                "files": [relative(f, sequence.root) for f in sequence.files()],
                "fps": FPS,
                "frames": [0, frames],
                "joint": {
                    "child": 0,
                    "parent": 1,
                    "axis": HINGE.tolist(),
                    "anchor": [0.0, 0.0, 0.0],
                },
                "parts": "two rigid bodies; the hinge is not kept",
            },
        )
    ]


def _read_hand(sequence: ArcticSequence, hands: object, side: Side) -> np.ndarray:
    where = f"{sequence.file('mano')}: {side} hand"
    hand = part(hands, side, where=str(sequence.file("mano")))
    model = load_mano(sequence.mano, side)
    fingers = model.add_mean(track(hand, "pose", 45, where=where))
    turn, place = (track(hand, key, 3, where=where) for key in ("rot", "trans"))
    same_length(
        {"rot": len(turn), "pose": len(fingers), "trans": len(place)}, where=where
    )
    return model.keypoints(
        rotations_from_axis_angle(np.concatenate([turn, fingers], axis=1)),
        to_array(part(hand, "shape", where=where), 10, what=f"{where}: shape"),
        place,
        convention="joint",
    )


def _read_objects(sequence: ArcticSequence) -> list[DemoObject]:
    """The top, turned about the hinge, and the bottom."""
    file = sequence.file("object")
    stored = track({"array": load_object_array(file)}, "array", 7, where=str(file))
    seen = ~missing_frames(stored)
    turns = Rotation.from_rotvec(stored[seen, 1:4])
    place = stored[:, 4:] * MILLIMETRE
    opened = turns * Rotation.from_rotvec(stored[seen, :1] * HINGE)
    bodies = []
    for name, turn in zip(PARTS, (opened, turns), strict=True):
        mesh = sequence.meshes / f"{name}.obj"
        if not mesh.is_file():
            raise DemoError(
                f"{mesh}: mesh not found (E_FILE). Unpack meta.zip, or name the folder "
                f"of object_vtemplates with --models."
            )
        body = scaled_mesh(mesh, MILLIMETRE)
        pose = pose_track(turn, place, seen)
        bodies.append(DemoObject(f"{sequence.object}_{name}", body, pose))
    return bodies


def _read_splits(file: Path, *, given: Path | None) -> dict[str, str]:
    """Split by sequence, from a protocol of the dataset; empty if there is none."""
    if given is None and not file.is_file():
        return {}
    try:
        protocol = json.loads(file.read_text(encoding="utf-8"))
        return {str(n): str(s) for s, names in protocol.items() for n in names}
    except (
        *(OSError, ValueError, AttributeError),
        *(TypeError, RecursionError),
    ) as error:
        raise DemoError(
            f"{file}: expected a JSON object of splits, each a list of "
            f"<subject>/<sequence>, as in splits_json/protocol_p1.json: {error}"
        ) from error


ARCTIC = Source(
    list=list_arctic,
    about="ARCTIC: raw_seqs and meta/object_vtemplates; needs MANO",
    licence="ARCTIC: non-commercial research, no redistribution",
    needs=("path", "mano"),
)
