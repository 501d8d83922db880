"""Reads SPIDER's human references: ``trajectory_keypoints.npz``.

They lie in ``processed/<dataset>/mano/<embodiment>/<task>/<id>/``: per side s
``qpos_wrist_{s}`` (T, 7), ``qpos_finger_{s}`` (T, 5, 7), thumb to pinky, and
``qpos_obj_{s}`` (T, 7); positions in metres and quaternions wxyz, z up. A side that
takes no part is zero. ``task_info.json``, there or one level up, names the meshes'
folders and the time step ``ref_dt``; without it the rate is 50 Hz. An object that both
hands use stands on the right only. Knuckles are not stored (see ``spider.hand``).
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import QUAT_TOLERANCE, DemoObject, HumanDemo
from flashdex.datasets.fields import number, numbers
from flashdex.datasets.files import load_npz, read_json, refuse_clone
from flashdex.datasets.roots import find_mesh, listed_below, mesh_in, shown
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.spider.hand import fill_hand
from flashdex.datasets.tracks import FARTHEST, same_track
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side

INFO = "task_info.json"


def read_objects(
    data: dict[str, Any], file: Path, info: dict[str, Any], objects: Path | None
) -> list[tuple[Side, DemoObject]]:
    """Objects with their side; the same object given on both sides counts once."""
    bodies: list[tuple[Side, DemoObject]] = []
    for side in reversed(SIDES):  # a shared object stands on the right
        folder = info.get(f"{side}_object_mesh_dir")
        if not folder or f"qpos_obj_{side}" not in data:
            continue
        stored = numbers(data[f"qpos_obj_{side}"], what=f"{file}: qpos_obj_{side}")
        if stored.ndim != 2 or stored.shape[1] != 7:
            raise DemoError(f"{file}: qpos_obj_{side} {stored.shape}; expected (T, 7).")
        pose = pose_track(stored, f"{file}: qpos_obj_{side}")
        mesh = _mesh(file, str(folder), objects)
        twin = any(b.mesh == mesh and same_track(b.pose, pose) for _, b in bodies)
        # arcticv2 names the right hand's mesh on both sides; a side of zeros is empty
        if not twin and np.abs(stored[:, :3]).max(initial=0.0) > 0:
            bodies.append((side, DemoObject(_tail(str(folder)), mesh, pose)))
    if not bodies:
        raise DemoError(
            f"{file}: no object. Its meshes are named by right_object_mesh_dir or "
            f"left_object_mesh_dir of {INFO} (there or one folder up); "
            f"found: {', '.join(map(str, info)) or 'no such file'}."
        )
    return bodies


def hand_object(
    bodies: list[tuple[Side, DemoObject]], hands: list[Side]
) -> dict[Side, int]:
    """Each hand's own object; contact decides where one object may serve two hands."""
    if len(bodies) == 1 and len(hands) == 2:
        return {}
    return {side: i for i, (side, _) in enumerate(bodies) if side in hands}


def pose_track(stored: np.ndarray, what: str) -> np.ndarray:
    """Pose track with NaN where the quaternion is zero."""
    norm = np.linalg.norm(stored[:, 3:], axis=-1)
    seen = (norm > 0) & (np.abs(stored) < FARTHEST).all(axis=-1)
    if (np.abs(norm[seen] - 1) > QUAT_TOLERANCE).any():
        raise DemoError(f"{what}: quaternions of norm {norm[seen].max():.3f}; unit.")
    return np.where(seen[:, None], stored, np.nan)


def _mesh(file: Path, folder: str, objects: Path | None) -> Path:
    """The mesh in ``folder``, which is absolute or seen from the dataset's root."""
    name = _tail(folder)
    if objects is None:
        for root in file.resolve().parents:
            if (found := mesh_in(root / folder)) is not None:
                return found
    places = [objects] if objects else [p / "assets" / "objects" for p in file.parents]
    return find_mesh(name, places, where=file)


def _tail(folder: str) -> str:
    return Path(folder.replace("\\", "/")).name


def task_info(file: Path) -> tuple[dict[str, Any], Path | None]:
    """``task_info.json`` beside a reference or one folder up; empty without one."""
    for folder in (file.parent, file.parent.parent):
        file = folder / INFO
        if file.is_file():
            info = read_json(file, "not readable JSON")
            if not isinstance(info, dict):
                raise DemoError(f"{file}: expected a JSON object.")
            return info, file
    return {}, None


def known_files(file: Path, objects: Path | None) -> tuple[Path, ...]:
    """Info and meshes as far as they are found; reading tells what is missing."""
    try:
        info, info_file = task_info(file)
    except DemoError:
        return ()
    meshes = set()
    for side in SIDES:
        with suppress(DemoError, OSError):  # one side may have no mesh and need none
            if folder := info.get(f"{side}_object_mesh_dir"):
                meshes.add(_mesh(file, str(folder), objects))
    return (*([info_file] if info_file else []), *sorted(meshes))


FILE = "trajectory_keypoints.npz"
FPS = 50.0  # SPIDER's reference rate, 0.02 s a frame
ABSENT_SPREAD = 1e-3  # m; tips that never part by more are those of an absent hand
# Tips farther than this from a nominal hand's, rms, m, are not those of a hand at this
# wrist; 24 recorded hands stay below 0.09.
MAX_TIP_ERROR = 0.12
# SPIDER's reader of GigaHands stores MANO's translation as the wrist [read in its
# source, dbcb27b]. The wrist is MANO's rest joint away, turning with the hand; in the
# axes of a right palm, m, to about 1 cm (datasets.md 3.1).
MANO_WRIST = np.array([-0.10, -0.01, -0.01])
NO_WRIST = {"gigahand": MANO_WRIST, "gigahands": MANO_WRIST}
# Its first reader of HOT3D stores the pose of MANO's root joint and poses the fingers
# from it as if it were the wrist; its later sets (hot3d_v2) are sound.
REFUSED = ("hot3d",)
# Do as I Do also stores the joints next to the tips, (T, 5, 3)
JOINT_KEYS = {"qpos_pip_{}": (2, 6, 10, 14, 18), "qpos_dip_{}": (3, 7, 11, 15, 19)}


def list_spider(options: SourceOptions) -> list[Recording]:
    """All references below a folder, or one file, in path order."""
    path = options.folder("path")
    files = [path] if path.is_file() else listed_below(path, FILE)
    if not files:
        raise DemoError(
            f"{path}: no {FILE}. Found: {shown(path)}. Give "
            f"SPIDER's dataset folder (the one that holds processed/), or unpack it. "
            f"Robot results (trajectory_mjwp.npz) are not human references.",
            code="E_ROOT",
        )
    refuse_clone(files[:1])
    names = [_name(file) for file in files]
    return [
        Recording(
            name=name if names.count(name) == 1 else "_".join(file.parent.parts[-5:]),
            read=partial(read_spider, file, options.models),
            files=(file, *known_files(file, options.models)),
        )
        for name, file in zip(names, files, strict=True)
    ]


def read_spider(file: Path, objects: Path | None = None) -> list[HumanDemo]:
    """One reference as one motion."""
    data, (info, info_file) = load_npz(file), task_info(file)
    dataset = _dataset(file, info)
    keypoints: dict[Side, np.ndarray] = {}
    notes: dict[str, Any] = {}
    for side in SIDES:
        if (hand := _read_hand(data, side, file, dataset)) is not None:
            keypoints[side], notes[side] = hand
    if not keypoints:
        raise DemoError(
            f"{file}: no hand. Expected qpos_wrist_right and qpos_finger_right, or "
            f"left, with tips apart; found: {', '.join(sorted(data))}."
        )
    bodies = read_objects(data, file, info, objects)
    step = number(info.get("ref_dt") or 1 / FPS, what=f"{info_file}: ref_dt")
    if not step > 0:
        raise DemoError(f"{info_file}: ref_dt is {step}; it must be positive, seconds.")
    pip = any(f"qpos_pip_{side}" in data for side in keypoints)
    return [
        HumanDemo(
            name=_name(file),
            fps=1 / step,
            keypoints=keypoints,
            objects=[body for _, body in bodies],
            hand_object=hand_object(bodies, list(keypoints)),
            source=SOURCE.name,
            licence=SOURCE.licence,
            task=str(info.get("task", "")),
            provenance={
                "files": [file.name, *([INFO] if info_file else [])],
                "keypoints": "tips, PIP and DIP only" if pip else "tips only",
                "made_up": notes,
                "fps": "ref_dt" if info.get("ref_dt") else "SPIDER's reference rate",
            },
        )
    ]


def _read_hand(
    data: dict[str, Any], side: Side, file: Path, dataset: str
) -> tuple[np.ndarray, dict[str, Any]] | None:
    if f"qpos_finger_{side}" not in data or f"qpos_wrist_{side}" not in data:
        return None
    wrist = numbers(data[f"qpos_wrist_{side}"], what=f"{file}: qpos_wrist_{side}")
    finger = numbers(data[f"qpos_finger_{side}"], what=f"{file}: qpos_finger_{side}")
    if finger.ndim != 3 or finger.shape[1:] != (5, 7) or wrist.shape[1:] != (7,):
        raise DemoError(
            f"{file}: qpos_finger_{side} {finger.shape} and qpos_wrist_{side} "
            f"{wrist.shape}; expected (T, 5, 7) and (T, 7)."
        )
    tips = np.where(np.abs(finger[..., :3]) < FARTHEST, finger[..., :3], np.nan)
    if not np.nan_to_num(np.ptp(tips, axis=1)).max(initial=0.0) > ABSENT_SPREAD:
        return None
    offset = NO_WRIST.get(dataset)
    frame = pose_track(wrist, f"{file}: qpos_wrist_{side}")
    hand = fill_hand(frame, tips, side, wrist_in_palm=offset)
    if offset is not None:
        hand.notes["wrist"] = "MANO translation, moved to the nominal wrist"
    error = hand.notes.get("best_axes_m", 0.0)
    if error > MAX_TIP_ERROR:
        raise DemoError(
            f"{file}: tips of the {side} hand are {error:.2f} m (rms) from where a "
            f"hand at qpos_wrist_{side} has them, whichever way its axes lie. Expected "
            f"the wrist and five tips (thumb to pinky), metres, in one world."
        )
    for key, places in JOINT_KEYS.items():
        joints = data.get(key.format(side))
        if joints is not None and np.shape(joints) == (len(tips), 5, 3):
            hand.keypoints[:, places] = joints
    return hand.keypoints, hand.notes


def _dataset(file: Path, info: dict[str, Any]) -> str:
    parts = file.parent.parts
    above = parts[parts.index("processed") + 1 :] if "processed" in parts else ()
    dataset = str(info.get("dataset_name") or (above[0] if above else ""))
    if dataset in REFUSED:
        raise DemoError(
            f"{file}: SPIDER's '{dataset}' holds no wrist: its reader stored the root "
            f"joint of MANO in its place. Read HOT3D itself, or its set hot3d_v2."
        )
    return dataset


def _name(file: Path) -> str:
    """``<dataset>_<embodiment>_<task>_<id>``."""
    parts = list(file.parent.parts)
    if "processed" in parts:
        parts = parts[len(parts) - parts[::-1].index("processed") :]
        parts = parts[:1] + parts[2:] if len(parts) > 4 else parts  # not the robot
    else:
        parts = parts[-2:]
    return "_".join(parts)


SOURCE = Source(
    name="spider",
    list=list_spider,
    about="SPIDER's processed human references (trajectory_keypoints.npz)",
    licence="that of the recordings they were made from; SPIDER itself is CC BY-NC 4.0",
)
