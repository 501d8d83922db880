"""The objects of a HOT3D sequence: library of models, poses, what moves most."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import DemoObject
from flashdex.datasets.files import read_json, refuse_clone, refuse_pointer, told
from flashdex.datasets.hot3d.files import FrameAxis, Track
from flashdex.errors import DemoError

LIBRARY_NAMES = ("assets", "object_models", "object_library")
INSTANCES = "instance.json"
MIN_NORM = 0.5  # of a quaternion; below, it is a filler and no rotation


@dataclass(frozen=True)
class ObjectLibrary:
    """Folder of ``<uid>.glb`` and the names of the objects."""

    folder: Path

    def mesh(self, uid: str) -> Path:
        """Where the model of an object lies, whether or not it is there."""
        return self.folder / f"{uid}.glb"

    def names(self) -> dict[str, str]:
        """Name of each object by uid; empty without ``instance.json``."""
        file = self.folder / INSTANCES
        if not file.is_file():
            return {}
        fault = "not {uid: {instance_name: ...}}"
        with told(file, fault):
            found = read_json(file, fault)
            return {uid: str(body["instance_name"]) for uid, body in found.items()}

    def key(self) -> str:
        """Names and sizes of all models, as text: changes when one is added."""
        models = [f for f in sorted(self.folder.glob("*.glb")) if f.is_file()]
        return " ".join(f"{file.name}:{file.stat().st_size}" for file in models)


def find_library(root: Path, given: Path | None) -> ObjectLibrary:
    """The object library: the folder given, or one beside or in the dataset."""
    if given is not None:
        places = [given, *(given / name for name in LIBRARY_NAMES)]
    else:
        above = [root, *list(root.resolve().parents)[:2]]
        places = [folder / name for folder in above for name in LIBRARY_NAMES]
    for folder in places:
        models = sorted(folder.glob("*.glb"))
        if models:
            refuse_clone(models[:1])
            return ObjectLibrary(folder)
    sought = ", ".join(str(place) for place in places)
    archives = sorted(p.name for p in (given or root).glob("*.zip"))
    unpack = f" Unpack {', '.join(archives[:3])} first." if archives else ""
    raise DemoError(
        f"{given or root}: no object models: <uid>.glb and {INSTANCES}. "
        f"Sought in {sought}. Download the object library of HOT3D and give it as "
        f"--models.{unpack}",
        code="E_ROOT",
    )


def read_objects(
    name: str,
    tracks: dict[str, Track],
    axis: FrameAxis,
    allowed: np.ndarray,
    library: ObjectLibrary,
    names: dict[str, str],
) -> tuple[list[DemoObject], dict[str, Any]]:
    """Objects with a model, on the frames of the sequence.

    Args:
        name: of the sequence, for messages.
        tracks: poses by uid.
        axis: frames.
        allowed: frames in which object poses are valid, (T,).
        library: of the models.
        names: by uid, where ``instance.json`` has none.

    Returns:
        The objects; and for the provenance: which have no model, which moves most.
    """
    names = names | library.names()
    found: list[DemoObject] = []
    missing: list[str] = []
    moved: dict[str, float] = {}
    for uid, track in tracks.items():
        if uid != Path(uid).name:
            raise DemoError(f"{name}: object_uid '{uid}' must be a number, not a path.")
        pose = axis.sample(track)
        pose[~allowed] = np.nan
        pose[np.linalg.norm(pose[:, 3:], axis=1) < MIN_NORM] = np.nan
        if not np.isfinite(pose).all(axis=1).any():
            continue  # never tracked: nothing to reproduce
        label = names.get(uid, uid)
        moved[label] = travel(pose)
        if library.mesh(uid).is_file():
            refuse_pointer(library.mesh(uid))
            found.append(DemoObject(label, library.mesh(uid), pose))
        else:
            missing.append(label)
    if not found:
        raise DemoError(
            f"{name}: none of its objects can be used. Without a model in "
            f"{library.folder}: {', '.join(missing) or 'none'}; tracked in no valid "
            f"frame: {len(tracks) - len(moved)} of {len(tracks)}."
        )
    return found, _describe(moved, missing)


def travel(pose: np.ndarray) -> float:
    """Largest distance from where an object (T, 7) was first seen, m."""
    points = pose[np.isfinite(pose).all(axis=1), :3]
    return float(np.linalg.norm(points - points[0], axis=1).max())


def _describe(moved: dict[str, float], missing: list[str]) -> dict[str, Any]:
    most = max(moved, key=lambda name: moved[name])
    notes: dict[str, Any] = {"most_moved": {"object": most, "m": round(moved[most], 4)}}
    if missing:
        notes["missing_meshes"] = sorted(missing)
    if most in missing:
        text = (
            f"'{most}' moves most ({moved[most] * 1e3:.0f} mm) but has no model: what "
            f"is done with it is lost. Add its .glb to the object library."
        )
        notes["notes"] = [f"E_MESH: {text}"]
    return notes
