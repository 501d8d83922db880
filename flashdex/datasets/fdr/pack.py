"""``motion.pt`` of FlashDexRetarget: the clips of a collection, one after the other.

Per-frame arrays of all clips are concatenated; clip i owns ``motion_num_frames[i]``
rows from ``length_starts[i]``. Which object a clip uses stands in
``motion_object_slot_{s}``, a place in ``{s}_object_mesh_dirs`` (``objects/<id>``).
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from flashdex.datasets.fields import number, numbers, require
from flashdex.datasets.files import load_torch
from flashdex.datasets.tracks import VELOCITY_SIGMA
from flashdex.errors import DemoError
from flashdex.keys import SIDES

NAME = "motion.pt"
# The file has no rate; FDR resamples all that it imports to this one (method.md 14).
FPS = 60.0
FPS_TOLERANCE = 0.05  # a rate that velocities confirm within it needs no other
MIN_SPEED = 0.01  # m/s; slower wrists say nothing about the rate
TRACKS = ("mano_{}_joints", "mano_{}_wrist_pos", "mano_{}_wrist_rot")
REQUIRED = ("motion_num_frames", "length_starts", "motion_filename")


def pack_names(file: Path) -> list[str]:
    """Names of the clips; a repeated name gets its row."""
    names = [Path(str(name)).stem for name in _open(file)["motion_filename"]]
    count = Counter(names)
    return [n if count[n] == 1 else f"{n}_{i}" for i, n in enumerate(names)]


def pack_objects(file: Path) -> list[str]:
    """Ids of all objects of the collection."""
    pack = _open(file)
    dirs = [d for s in SIDES for d in pack.get(f"{s}_object_mesh_dirs") or []]
    return sorted({Path(str(d)).name for d in dirs})


def unpack(file: Path, row: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """The arrays of one clip, by the names of ``human_demo/<clip>.npz``, and notes."""
    pack = _open(file)
    start = int(pack["length_starts"][row])
    end = start + int(pack["motion_num_frames"][row])
    clip: dict[str, Any] = {}
    for side in SIDES:
        for track in (key.format(side) for key in TRACKS):
            if track in pack:
                clip[track] = _rows(pack, track, start, end, file)
        if f"mano_{side}_joint_names" in pack:
            clip[f"mano_{side}_joint_names"] = pack[f"mano_{side}_joint_names"]
        if f"obj_{side}_pos" in pack:
            clip |= _object(pack, side, row, (start, end), file)
    if pack.get("support_disks") is not None:
        clip["support_disks"] = np.asarray(pack["support_disks"][row])
    clip["fps"], told = _rate(pack, start, end, file)
    return clip, {"fps": told, "packed_frames": [start, end]}


def _object(
    pack: dict[str, Any], side: str, row: int, span: tuple[int, int], file: Path
) -> dict[str, Any]:
    pos = _rows(pack, f"obj_{side}_pos", *span, file)
    pose = np.tile(np.eye(4), (len(pos), 1, 1))
    pose[:, :3, 3] = pos
    pose[:, :3, :3] = _rows(pack, f"obj_{side}_rotmat", *span, file)
    dirs = list(pack.get(f"{side}_object_mesh_dirs") or [])
    slots = pack.get(f"motion_object_slot_{side}")
    slot = -1 if slots is None else int(slots[row])
    if not 0 <= slot < len(dirs):
        raise DemoError(
            f"{file}: motion_object_slot_{side}[{row}] = {slot}, but "
            f"{side}_object_mesh_dirs has {len(dirs)} entries."
        )
    # two names of the same list are in use
    scales = pack.get(f"{side}_object_mesh_scales", pack.get(f"{side}_object_scales"))
    scale = 1.0
    if scales is not None and len(scales):
        scale = number(scales[slot], what=f"{file}: scale of {dirs[slot]}")
    return {
        f"obj_{side}_pose": pose,
        f"obj_{side}_id": Path(str(dirs[slot])).name,
        f"obj_{side}_scale": scale,
    }


def _rows(pack: dict[str, Any], key: str, start: int, end: int, file: Path) -> Any:
    if key not in pack or not 0 <= start < end <= len(pack[key]):
        has = f"{len(pack[key])} rows" if key in pack else "no such array"
        raise DemoError(f"{file}: rows {start} to {end} of {key} are wanted; {has}.")
    return numbers(pack[key][start:end], what=f"{file}: {key}")


def _rate(
    pack: dict[str, Any], start: int, end: int, file: Path
) -> tuple[float, dict[str, Any]]:
    """Frames a second: 60, unless the stored velocities say something else.

    The velocities are smoothed differences of the positions times the rate, so their
    ratio gives the rate back.
    """
    told: dict[str, Any] = {"value": FPS, "from": "FDR's import rule; not in the file"}
    for side in SIDES:
        keys = [f"mano_{side}_wrist_{k}" for k in ("pos", "vel")]
        if end - start < 3 or any(key not in pack for key in keys):
            continue
        pos, speed = (_rows(pack, key, start, end, file) for key in keys)
        steps = np.gradient(pos, axis=0)
        steps = gaussian_filter1d(steps, VELOCITY_SIGMA, axis=0, mode="nearest")
        if not np.isfinite(pos).all() or np.abs(speed).max() < MIN_SPEED:
            continue
        rate = float((speed * steps).sum() / (steps * steps).sum())
        told["measured"] = round(rate, 2)
        if abs(rate / FPS - 1) > FPS_TOLERANCE:
            told |= {"value": round(rate, 2), "from": "the stored wrist velocities"}
        break
    if not told["value"] > 0:
        raise DemoError(f"{file}: wrist velocities do not fit the wrist positions.")
    return float(told["value"]), told


def _open(file: Path) -> dict[str, Any]:
    return _load(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # a worker reads many clips of one file
def _load(file: Path, stamp: int) -> dict[str, Any]:
    pack = load_torch(file)
    require(pack, *REQUIRED, where=f"{file}: not a motion.pt of FlashDexRetarget")
    return pack
