"""What a SPIDER reference is about: its task, its objects and their meshes."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import QUAT_TOLERANCE, DemoObject
from flashdex.datasets.fields import numbers
from flashdex.datasets.files import read_json
from flashdex.datasets.roots import find_mesh, mesh_in
from flashdex.datasets.tracks import FARTHEST
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
        twin = any(b.mesh == mesh and _same_track(b.pose, pose) for _, b in bodies)
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


def _same_track(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and np.allclose(one, other, equal_nan=True)


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
