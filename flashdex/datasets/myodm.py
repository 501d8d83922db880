"""Reads MyoDM: 95 recorded clips of a right hand and one object, 50 frames a second.

``flashdex fetch myodm`` lays the folder out: ``clips/<object>_<action>.npz`` with
``robot`` (T, 29), joint positions of the MyoHand model, and ``object`` (T, 7), position
and quaternion wxyz; ``meshes/<object>.stl``, metres; ``myohand_body.xml``, the hand's
tree. z up, table top at z = 0. Keypoints come from the hand's forward kinematics.
"""

from __future__ import annotations

import re
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from flashdex.datasets.body_models.myohand import NUM_JOINTS, myohand_keypoints
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fetch import NOTE, myodm_dir
from flashdex.datasets.fields import require
from flashdex.datasets.files import load_npz, read_json
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError

FPS = 50.0
# Recorded heights are slides of a body that stands this high, m ...
BODY_HEIGHT = 0.035
# ... except where ``object_init`` has six entries: those heights are absolute.
ABSOLUTE_ENTRIES = 6
# These stand 5 to 6 cm below the table: theirs is estimated from where they rest.
SUNK = {"wineglass"}
KEYS = ("time", "robot", "object", "object_init")
OBJECT_NAME = re.compile(r"[a-z]+")


def list_myodm(options: SourceOptions) -> list[Recording]:
    """Clips of the fetched folder, in name order."""
    root = options.path or myodm_dir()
    hand = root / "myohand_body.xml"
    clips = sorted((root / "clips").glob("*.npz"))
    if not clips or not hand.is_file():
        raise DemoError(
            f"{root}: no MyoDM recordings (clips/*.npz and myohand_body.xml). "
            f"Get them with: flashdex fetch myodm"
        )
    return [
        Recording(
            name=clip.stem,
            read=partial(read_clip, clip),
            files=(clip, hand, *([m] if (m := _mesh_file(clip)).is_file() else [])),
        )
        for clip in clips
    ]


def read_clip(file: Path) -> list[HumanDemo]:
    """One clip as one motion."""
    data = _load(file)
    root = file.parent.parent
    points = myohand_keypoints(root / "myohand_body.xml", data["robot"])
    pose = data["object"].astype(np.float64)
    lift = 0.0 if data["object_init"].size == ABSOLUTE_ENTRIES else BODY_HEIGHT
    pose[:, 2] += lift
    name = _object_name(file)
    return [
        HumanDemo(
            name=file.stem,
            fps=FPS,
            keypoints={"right": points},
            objects=[DemoObject(name, _mesh_file(file), pose)],
            source=SOURCE.name,
            licence=SOURCE.licence,
            support_z=None if name in SUNK else 0.0,
            task=file.stem.removeprefix(f"{name}_"),
            provenance={
                "files": [f"clips/{file.name}", f"meshes/{name}.stl"],
                "fps": FPS,
                "object_z_offset": lift,
                **_origin(root),
            },
        )
    ]


def _load(file: Path) -> dict[str, np.ndarray]:
    stored = load_npz(file, only=KEYS, plain=True)
    require(stored, *KEYS, where=f"{file}: not a MyoDM clip")
    data = {key: stored[key] for key in KEYS}
    if data["time"].ndim != 1 or data["time"].dtype.kind != "f":
        raise DemoError(f"{file}: 'time' must be a list of seconds, (T,).")
    frames = len(data["time"])
    expected = {"robot": (frames, NUM_JOINTS), "object": (frames, 7)}
    for key, shape in expected.items():
        if data[key].shape != shape or data[key].dtype.kind != "f":
            raise DemoError(
                f"{file}: '{key}' is {data[key].dtype} {data[key].shape}, expected "
                f"float {shape}."
            )
    steps = np.diff(data["time"])
    if len(steps) and not np.allclose(steps, 1 / FPS, atol=1e-6):
        raise DemoError(f"{file}: time does not advance by {1 / FPS} s a frame.")
    return data


def _object_name(file: Path) -> str:
    match = OBJECT_NAME.match(file.stem)
    if match is None:
        raise DemoError(f"{file}: the name must begin with the object's name.")
    return match[0]


def _mesh_file(clip: Path) -> Path:
    return clip.parent.parent / "meshes" / f"{_object_name(clip)}.stl"


def _origin(root: Path) -> dict[str, str]:
    """Package and hash of the fetched folder; nothing for a folder made by hand."""
    file = root / "source.json"
    if not file.is_file():
        return {}
    with suppress(DemoError, KeyError, TypeError):
        stored = read_json(file, "not JSON")
        return {"package": str(stored["source"]), "sha256": str(stored["sha256"])}
    return {}


SOURCE = Source(
    name="myodm",
    list=list_myodm,
    about="the folder of `flashdex fetch myodm` (found by itself)",
    licence=NOTE,
    needs=(),
)
