"""The world of a HOT3D sequence: its headset, which axis is up, its objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flashdex.datasets.demo import DemoObject
from flashdex.datasets.files import read_json, refuse_clone, refuse_pointer, told
from flashdex.datasets.hot3d.files import FrameAxis, Track, text_of
from flashdex.datasets.roots import listed, on_disk
from flashdex.errors import DemoError
from flashdex.system.files import hash_file
from flashdex.system.jsonl import parse_json

Up = Literal["z", "y"]
# Aria: origin near the first headset position; Quest: origin on the floor
UP_OF: dict[str, Up] = {"aria": "z", "quest": "y"}
TEST_PARTICIPANTS = ("P0004", "P0005", "P0006", "P0008", "P0016", "P0020")
MIN_HEAD_HEIGHT = 0.05  # of the headset above the objects, m
# how much flatter the objects must lie along another axis to make the first one wrong
FLATTER = 3.0


@dataclass(frozen=True)
class Metadata:
    """What ``metadata.json`` says, in either of its two layouts."""

    headset: str  # ``Aria``, ``Quest3``
    participant: str  # such as ``P0003``
    # whether poses exist, per kind: ``objects``, ``mano``, ``umetrack``; a kind
    # of which nothing is said is missing here
    truth: dict[str, bool] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)  # of objects, by uid, if listed
    version: str = ""  # of the dataset, where it is given


def read_metadata(file: Path) -> Metadata:
    """``metadata.json``, old and new layout."""
    fault = "not the metadata of a HOT3D sequence, JSON with headset, participant_id"
    with told(file, fault):
        data = parse_json(text_of(file).encode("utf-8"))
        uids, names = data.get("object_uids") or [], data.get("object_names") or []
        return Metadata(
            headset=str(data.get("headset", "")),
            participant=str(data.get("participant_id", "")),
            truth=_truth(data),
            names={str(u): str(n) for u, n in zip(uids, names, strict=False)},
            version=next((str(v) for k, v in data.items() if "version" in k), ""),
        )


def _truth(data: dict[str, Any]) -> dict[str, bool]:
    keys = {
        "objects": "object_pose_gt",
        "mano": "mano_hand_pose_gt",
        "umetrack": "umetrack_hand_pose_gt",
    }
    if "have_hand_object_pose_gt" in data:
        return dict.fromkeys(keys, bool(data["have_hand_object_pose_gt"]))
    status = dict(data.get("gt_available_status") or {})
    return {kind: bool(status[key]) for kind, key in keys.items() if key in status}


def refuse_without_truth(folder: Path, metadata: Metadata, hands: str) -> None:
    """Refuse a sequence whose poses were not published; hands: mano or umetrack."""
    kinds = {"objects": "object poses", hands: f"{hands} hand poses"}
    missing = [
        text for kind, text in kinds.items() if not metadata.truth.get(kind, True)
    ]
    is_test = metadata.participant in TEST_PARTICIPANTS
    if is_test and not (folder / "dynamic_objects.csv").is_file():
        missing = missing or list(kinds.values())
    if missing:
        test = f"{metadata.participant} belongs to the test set" if is_test else ""
        raise DemoError(
            f"{folder.name}: skipped, it has no ground truth for "
            f"{' and '.join(missing)}{'; ' + test if test else ''}. Nothing is wrong "
            f"with the download."
        )


def up_axis(
    name: str, headset: str, head: np.ndarray, objects: list[np.ndarray]
) -> tuple[Up, dict[str, Any]]:
    """The axis that points up: by the headset, verified with the data.

    The headset must be above the objects. Where the other axis puts the headset higher
    and at the same time finds the objects lying much flatter, the metadata is wrong.

    Positions of the headset (empty if not known) and of each object, m, world, (T, 3).
    Returns the axis, and what was measured.
    """
    kind = next((kind for kind in UP_OF if headset.lower().startswith(kind)), None)
    if kind is None:
        raise DemoError(
            f"{name}: metadata.json names the headset '{headset}'; allowed: Aria "
            f"(z up), Quest3 (y up). The up axis depends on it."
        )
    up = UP_OF[kind]
    middles = [_middle(points) for points in (head, *objects)]
    centres = np.array([middle for middle in middles[1:] if middle is not None])
    if middles[0] is None or not len(centres):
        return up, {"up_check": "by the headset's name only: no headset trajectory"}
    height = middles[0] - np.median(centres, axis=0)
    spread = np.ptp(centres, axis=0)
    axis, other = ("xyz".index(up), "xyz".index("y" if up == "z" else "z"))
    flatter = len(centres) > 1 and spread[other] * FLATTER < spread[axis]
    if height[axis] < MIN_HEAD_HEIGHT or (height[other] > height[axis] and flatter):
        raise DemoError(
            f"{name}: {headset} means {up} up, but along {up} the headset is "
            f"{height[axis]:.2f} m above the objects, which spread {spread[axis]:.2f} "
            f"m; along {'xyz'[other]} it is {height[other]:.2f} m and "
            f"{spread[other]:.2f} m. Check 'headset' in metadata.json."
        )
    return up, {"headset_above_objects_m": round(float(height[axis]), 3)}


def _middle(points: np.ndarray) -> np.ndarray | None:
    """Median of the finite rows of (N, 3); None without any."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.median(finite, axis=0) if len(finite) else None


LIBRARY_NAMES = ("assets", "object_models", "object_library")
INSTANCES = "instance.json"
MIN_NORM = 0.5  # of a quaternion; below, it is a filler and no rotation


@dataclass(frozen=True)
class ObjectLibrary:
    """Folder of ``<uid>.glb`` and the names of the objects."""

    folder: Path

    def mesh(self, uid: str) -> Path:
        """Where the model of an object lies, whether or not it is there."""
        return on_disk(self.folder / f"{uid}.glb")

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
        """Names and content of all models, as text: changes when one does."""
        models = [f for f in listed(self.folder, "*.glb") if f.is_file()]
        return " ".join(f"{file.name}:{hash_file(file)}" for file in models)


def find_library(root: Path, given: Path | None) -> ObjectLibrary:
    """The object library: the folder given, or one beside or in the dataset."""
    if given is not None:
        places = [given, *(given / name for name in LIBRARY_NAMES)]
    else:
        above = [root, *list(root.resolve().parents)[:2]]
        places = [folder / name for folder in above for name in LIBRARY_NAMES]
    for folder in places:
        models = listed(folder, "*.glb")
        if models:
            refuse_clone(models[:1])
            return ObjectLibrary(folder)
    sought = ", ".join(str(place) for place in places)
    archives = [p.name for p in listed(given or root, "*.zip")]
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

    Tracks by uid, NaN where not ``allowed`` (T,); names by uid, where
    ``instance.json`` has none. For the provenance: which have no model, which moves
    most.
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
