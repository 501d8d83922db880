"""Reads GRAB: a body that grasps one object on a table, 120 Hz, z up, metres.

``grab/s1 ... s10/<object>_<action>_<take>.npz`` holds nested tables: ``lhand`` and
``rhand`` with ``params`` (``global_orient`` (T, 3), ``fullpose`` (T, 45), ``transl``
(T, 3)) and ``vtemp``, the file of the subject's own hand, which replaces MANO's; flat
hand, no shape. ``object`` and ``table`` have ``params`` and a mesh. Their vertices are
rows that are multiplied from the left, v R + t: the stored rotation is **transposed**.
Only the hands are used of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import NUM_VERTICES, load_mano, mano_pair
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fields import number, part, pose_track, same_length, track, word
from flashdex.datasets.files import load_npz, refuse_clone
from flashdex.datasets.roots import (
    listed,
    on_disk,
    relative,
    require_folders,
    require_mesh,
)
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.errors import DemoError, MeshError
from flashdex.keys import SIDES, Side
from flashdex.objects.meshes import load_mesh

FPS = 120.0
SEQUENCES, TOOLS = "grab", "tools"
MESHES = "object_meshes/contact_meshes"  # below TOOLS
HANDS: dict[Side, str] = {"left": "lhand", "right": "rhand"}
# objects of the dataset's own test and validation splits; the others are for training
SPLITS = {
    **dict.fromkeys(("mug", "wineglass", "camera", "binoculars"), "test"),
    **dict.fromkeys(("fryingpan", "toothpaste"), "test"),
    **dict.fromkeys(("apple", "toothbrush", "elephant", "hand"), "val"),
}


@dataclass(frozen=True, kw_only=True)
class GrabSequence:
    """Where one sequence lies."""

    root: Path
    file: Path
    models: Path | None  # in place of tools/object_meshes/contact_meshes
    mano: Path

    @property
    def name(self) -> str:
        """``<subject>_<object>_<action>_<take>``."""
        return f"{self.file.parent.name}_{self.file.stem}"

    @property
    def object(self) -> str:
        """The object's name, from the file name."""
        return self.file.stem.split("_")[0]

    @property
    def split(self) -> str:
        """By object, as the dataset's own preprocessing has it."""
        return SPLITS.get(self.object, "train")

    def mesh(self, stored: str) -> Path:
        """The file that a path in the sequence names."""
        own = Path(stored.replace("\\", "/"))
        if own.is_absolute() or ".." in own.parts:
            raise DemoError(f"{self.file}: mesh '{stored}' is not inside the dataset.")
        apart = on_disk(self.models / own.name) if self.models else None
        return apart if apart and apart.is_file() else on_disk(self.root / own)

    def files(self) -> list[Path]:
        """Every file that it depends on and that exists."""
        folders = [self.root / TOOLS / MESHES, *([self.models] if self.models else [])]
        names = (f"{self.object}.ply", "table.ply")
        meshes = [on_disk(folder / name) for folder in folders for name in names]
        people = self.root / TOOLS / "subject_meshes"
        hands = listed(people, f"*/{self.file.parent.name}_[lr]hand.ply")
        return [file for file in (self.file, *meshes, *hands) if file.is_file()]


def list_grab(options: SourceOptions) -> list[Recording]:
    """All sequences, in name order."""
    root, mano = options.folder("path"), options.folder("mano")
    require_folders(root, (SEQUENCES, TOOLS), dataset="GRAB")
    models = mano_pair(mano)
    files = listed(root / SEQUENCES, "s*/*.npz")
    if not files:
        raise DemoError(
            f"{root / SEQUENCES}: no s1 ... s10/<object>_<action>_<take>.npz. "
            f"Unpack the archives with GRAB's grab/unzip_grab.py.",
            code="E_ROOT",
        )
    refuse_clone(files[:1])
    sequences = [
        GrabSequence(root=root, file=file, models=options.models, mano=mano)
        for file in files
    ]
    return [
        Recording(
            name=sequence.name,
            read=partial(read_sequence, sequence),
            files=(*sequence.files(), *models),
        )
        for sequence in sequences
    ]


def read_sequence(sequence: GrabSequence) -> list[HumanDemo]:
    """One sequence as one motion."""
    data, where = load_npz(sequence.file), str(sequence.file)
    keypoints: dict[Side, np.ndarray] = {
        s: _read_hand(sequence, data, s) for s in SIDES
    }
    pose, mesh = _read_body(sequence, data, "object")
    lengths = {f"{side} hand": len(track) for side, track in keypoints.items()}
    frames = same_length(lengths | {"object": len(pose)}, where=where)
    name = word(data.get("obj_name", sequence.object), what=f"{where}: obj_name")
    fps = number(data.get("framerate", FPS), what=f"{where}: framerate")
    height, decision = _support(sequence, data)
    return [
        HumanDemo(
            name=sequence.name,
            fps=fps,
            keypoints=keypoints,
            objects=[DemoObject(name, mesh, pose)],
            source=SOURCE.name,
            licence=SOURCE.licence,
            support_z=height,
            split=sequence.split,
            task=word(data.get("motion_intent", ""), what=f"{where}: motion_intent"),
            provenance={
                "files": [relative(f, sequence.root) for f in sequence.files()],
                "fps": fps,
                "frames": [0, frames],
                "support": decision,
                "split": "by object, as in GRAB's preprocessing",
            },
        )
    ]


def _read_hand(sequence: GrabSequence, data: dict[str, Any], side: Side) -> np.ndarray:
    where = f"{sequence.file}: {HANDS[side]}"
    hand = part(data, HANDS[side], where=str(sequence.file))
    params = part(hand, "params", where=where)
    model = load_mano(sequence.mano, side)
    if "fullpose" in params:
        fingers = track(params, "fullpose", 45, where=where)
    else:
        width = int(number(data.get("n_comps", 24), what=f"{where}: n_comps"))
        coefficients = track(params, "hand_pose", width, where=where)
        fingers = model.finger_pose(coefficients, flat=True)
    return model.keypoints_of(
        track(params, "global_orient", 3, where=where),
        fingers,
        track(params, "transl", 3, where=where),
        betas=None,
        convention="joint",
        template=_template(sequence, str(part(hand, "vtemp", where=where))),
        where=where,
    )


def _template(sequence: GrabSequence, stored: str) -> np.ndarray:
    """The subject's own hand, m, (778, 3), in the order of MANO's vertices."""
    file = sequence.mesh(stored)
    try:
        vertices = np.asarray(load_mesh(file).vertices)
    except MeshError as error:
        raise DemoError(f"{error} It is the subject's hand (vtemp).") from error
    if vertices.shape != (NUM_VERTICES, 3):
        raise DemoError(
            f"{file}: {len(vertices)} vertices; a hand of MANO has {NUM_VERTICES}."
        )
    return vertices


def _read_body(
    sequence: GrabSequence, data: dict[str, Any], key: str
) -> tuple[np.ndarray, Path]:
    """Pose track and mesh file of the object or the table."""
    where = f"{sequence.file}: {key}"
    body = part(data, key, where=str(sequence.file))
    params = part(body, "params", where=where)
    turn, place = (
        track(params, k, 3, where=where) for k in ("global_orient", "transl")
    )
    same_length({"global_orient": len(turn), "transl": len(place)}, where=where)
    mesh = sequence.mesh(str(part(body, f"{key}_mesh", where=where)))
    require_mesh(mesh, "Unpack tools.zip, or name the folder of contact_meshes")
    seen = ~missing_frames(turn, place)
    # v R + t turns by the transpose of R
    return pose_track(Rotation.from_rotvec(turn[seen]).inv(), place, seen), mesh


def _support(sequence: GrabSequence, data: dict[str, Any]) -> tuple[float | None, str]:
    """Height of the table's top, which stands still."""
    if "table" not in data:
        return None, "no table in the file: estimated from objects at rest"
    try:
        pose, mesh = _read_body(sequence, data, "table")
        vertices = np.asarray(load_mesh(mesh).vertices)
    except (DemoError, MeshError) as error:
        return None, f"the table cannot be read, so it is estimated: {error}"
    seen = np.flatnonzero(~missing_frames(pose))
    if not len(seen):
        return None, "the table was not tracked: estimated from objects at rest"
    first = pose[seen[0]]
    top = rotation(first[3:]).apply(vertices)[:, 2].max() + first[2]
    return float(top), "top of the table's mesh in its recorded pose"


SOURCE = Source(
    name="grab",
    list=list_grab,
    about="GRAB: grab/s*/*.npz and tools/; needs MANO",
    licence="GRAB: non-commercial research, no redistribution",
    needs=("path", "mano"),
)
