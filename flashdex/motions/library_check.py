"""Whether a motion library holds what it says, and numbers that physics can use.

All is checked once. That it was is remembered in the cache by the manifest's hash and
by size, times and inode of each file, so that the next opening costs next to nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import LibraryError
from flashdex.motions.library_format import (
    AGAIN,
    ARRAYS,
    FRAME_KEYS,
    OBJECT_KEYS,
    Manifest,
    as_library_error,
    hash_json,
)
from flashdex.motions.library_meshes import read_mesh
from flashdex.objects.asset import default_cache_dir
from flashdex.system.arrays import hash_content, map_array
from flashdex.system.files import own_file

Arrays = Mapping[str, np.ndarray]
CHECK_VERSION = 1  # raise when a library is checked for more
ROWS = 16_384  # checked at a time: the check of a large array needs little memory
# Smallest and largest value of each array; generous, what is beyond is no motion.
# m and rad: 100; m/s and rad/s: 10,000. NaN and infinity are in no range.
LIMITS = {
    **{name: (-100.0, 100.0) for name, (dtype, _) in ARRAYS.items() if "32" in dtype},
    **{f"frames/{k}": (-1e4, 1e4) for k in FRAME_KEYS if k.endswith("vel")},
    "frames/tip_dist": (0.0, 100.0),
    "objects/normals": (-1.001, 1.001),
    "objects/radius": (1e-5, 100.0),
    "objects/sdf_spacing": (1e-6, 10.0),
    "objects/mass": (1e-6, 1000.0),
}
del LIMITS["motions/support_disks"]
QUAT_SLACK = 1e-3  # of a norm from 1


def find_faults(manifest: Manifest, arrays: Arrays) -> list[str]:
    """What is wrong with the numbers of a library; each line names array and row.

    Raises:
        LibraryError: its frames are not those of its motions.
    """
    with np.errstate(all="ignore"):  # numbers of any kind are expected here
        return list(_faults(manifest, arrays))


def _faults(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    yield from _motion_faults(manifest, arrays)
    names = manifest.names("motions")
    starts = arrays["motions/start"]
    for name, array in arrays.items():
        per_object = manifest.names("objects") if name.startswith("objects/") else None
        row = None
        if name in LIMITS:
            row = _first(array, lambda v, n=name: _outside(v, *LIMITS[n]))
        if row is None and name.endswith("_quat"):
            row = _first(array, _no_rotation)
        if row is not None:
            where = _where(row, per_object, names, starts)
            yield f"{name}: {_values(array[row])} {where}"
    for row, name in enumerate(manifest.names("objects")):
        for fault in _body_faults(
            {k: arrays[f"objects/{k}"][row] for k in OBJECT_KEYS}
        ):
            yield f"object {name!a}: {fault}"


def _first(array: np.ndarray, is_bad: Any) -> int | None:
    """First row of an array with a bad value."""
    for start in range(0, len(array), ROWS):
        bad = is_bad(array[start : start + ROWS])
        if bad is not None and bad.any():
            return start + int(np.argmax(bad))
    return None


def _outside(values: np.ndarray, low: float, high: float) -> np.ndarray | None:
    # the smallest and the largest say it, NaN included, in one pass without copies
    if values.min() >= low and values.max() <= high:
        return None
    flat = values.reshape(len(values), -1)
    return np.asarray(~((flat >= low) & (flat <= high)).all(-1))


def _no_rotation(quat: np.ndarray) -> np.ndarray:
    norm = np.sqrt(np.square(quat, dtype=np.float64).sum(-1))
    return (np.abs(norm - 1) > QUAT_SLACK).reshape(len(quat), -1).any(-1)


def _values(row: np.ndarray) -> str:
    flat = np.asarray(row, np.float64).reshape(-1)
    odd = flat[~np.isfinite(flat)]
    if odd.size:
        return f"holds {odd[0]}"
    return f"holds {flat.min():.4g} ... {flat.max():.4g}, which cannot be"


def _where(row: int, objects: list[str] | None, names: list[str], starts: Any) -> str:
    if objects is not None:
        return f"at object {objects[row]!a}"
    motion = int(np.searchsorted(starts, row, side="right")) - 1
    return f"at frame {row - int(starts[motion])} of motion {names[motion]!a}"


def _motion_faults(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    """Rows of frames, objects and slots that motions name; raises where none do."""
    start, length = arrays["motions/start"], arrays["motions/length"]
    total = manifest.arrays["frames/joint_pos"].shape[0]
    index, slot = arrays["motions/object_index"], arrays["motions/hand_object"]
    ends = np.cumsum(length, dtype=np.float64)
    is_split = (length > 0).all() and ends[-1] == total
    if not is_split or (start != np.concatenate([[0], np.cumsum(length)[:-1]])).any():
        raise LibraryError(
            f"motions/start, motions/length: {int(ends[-1])} frames of {len(length)} "
            f"motions announced, {total} frames found, each of one motion."
        )
    if index.min() < -1 or index.max() >= manifest.arrays["objects/mass"].shape[0]:
        raise LibraryError("motions/object_index: names objects that are not there.")
    if slot.min() < -1 or slot.max() >= index.shape[1]:
        raise LibraryError("motions/hand_object: names slots that are not there.")
    held = np.take_along_axis(index, slot.clip(0), 1) < 0
    for row in np.flatnonzero((held & (slot >= 0)).any(1)):
        yield f"motions/hand_object: motion {row} holds an empty slot"
    for row in np.flatnonzero(~arrays["motions/hand_active"].any(1)):
        yield f"motions/hand_active: motion {row} has no hand"
    discs = arrays["motions/support_disks"]
    is_free = np.asarray(np.isnan(discs).all(-1))
    is_disc = np.asarray((np.abs(discs) <= 100).all(-1) & (discs[..., 3:] > 0).all(-1))
    is_late = is_disc[:, 1:] & is_free[:, :-1]  # the used ones come first
    for row in np.flatnonzero((~(is_free | is_disc)).any(-1) | is_late.any(-1)):
        yield f"motions/support_disks: those of motion {row} are no discs"


def _body_faults(body: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Of one object: a body that is not, or that no density could have."""
    (low, high), com = body["aabb"].astype(np.float64), body["com"]
    size = high - low
    inertia, mass = body["inertia"].astype(np.float64), float(body["mass"])
    if not np.isfinite(inertia).all():
        return  # that it is not was told
    if not (size > 0).all():
        yield "its box has no inside"
    slack = 0.1 * size.max() + 1e-3
    if ((com < low - slack) | (com > high + slack)).any():
        yield f"its centre of mass {com.tolist()} lies outside of its box"
    main = np.linalg.eigvalsh((inertia + inertia.T) / 2)
    scale = np.abs(inertia).max()
    if np.abs(inertia - inertia.T).max() > 1e-3 * scale or main[0] <= 0:
        yield "its inertia is not symmetric and positive"
    elif main[0] + main[1] < main[2] * (1 - 1e-3):
        yield "its inertia is that of no body: two of three moments are below the third"
    elif main.sum() > 2.2 * mass * float(size @ size):
        yield f"its inertia is larger than {mass:.4g} kg in its box can have"


def find_changes(path: Path, manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    """Files that are not those of the manifest, and meshes that are no bodies."""
    with as_library_error():
        for name, entry in manifest.arrays.items():
            if (
                hash_content(own_file(path, manifest.data, f"{name}.npy"))
                != entry.sha256
            ):
                yield f"{name}: was changed; its hash is not that of the manifest"
    is_whole = True
    for name, digest in manifest.meshes.items():
        try:
            read_mesh(path, manifest.data, name, digest)
        except LibraryError as error:
            is_whole = False
            yield str(error)
    if not is_whole:
        return
    found = hash_rows(manifest.entries, arrays, manifest.meshes)
    for part, hashes in zip(("motions", "objects"), found, strict=True):
        for row, digest in zip(manifest.entries[part], hashes, strict=True):
            if row["content_sha256"] != digest:
                yield f"{part}: {row['name']!a} is not what its hash says"


def map_arrays(path: Path, manifest: Manifest) -> dict[str, np.ndarray]:
    """Map all arrays of a library; nothing of their content is read.

    Raises:
        LibraryError: one is missing, a link, or not as the manifest announces it.
    """
    with as_library_error():
        return {
            name: map_array(path, f"{manifest.data}/{name}.npy", entry)
            for name, entry in manifest.arrays.items()
        }


def check_once(path: Path, manifest: Manifest, arrays: Arrays) -> None:
    """Check a library unless these very files were found to be whole before.

    Raises:
        LibraryError: something is wrong in it; says what and where.
    """
    mark = _mark(path, manifest)
    if mark is not None and mark.is_file():
        return
    faults = check_all(path, manifest, arrays)
    if faults:
        more = f"\n  and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise LibraryError(
            f"{path}: damaged, or changed after it was made:\n  "
            + "\n  ".join(faults[:5])
            + f"{more}\nNothing of it is used. {AGAIN}"
        )
    if mark is not None and mark == _mark(path, manifest):  # nobody wrote meanwhile
        with suppress(OSError):  # without a cache it is checked again
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()


def check_all(path: Path, manifest: Manifest, arrays: Arrays) -> list[str]:
    """Every fault of a library: its files' hashes, then its numbers."""
    faults = []
    for look in (find_changes(path, manifest, arrays), find_faults(manifest, arrays)):
        try:
            faults += look
        except LibraryError as error:
            faults.append(str(error))
    return faults


def _mark(path: Path, manifest: Manifest) -> Path | None:
    """File in the cache that stands for these files, as they are, being whole."""
    stamps = []
    files = [*(f"{name}.npy" for name in manifest.arrays), *manifest.meshes]
    try:
        root = default_cache_dir()
        for name in files:
            found = os.lstat(f"{path}/{manifest.data}/{name}")
            if not stat.S_ISREG(found.st_mode):
                return None
            # an edit that sets the time back has another time of change
            times = found.st_mtime_ns, found.st_ctime_ns
            stamps.append([found.st_dev, found.st_ino, found.st_size, *times])
    except (OSError, RuntimeError):  # a file is missing, or there is no home
        return None
    return root / "libraries" / hash_json([CHECK_VERSION, manifest.sha256, stamps])


def hash_rows(
    entries: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    meshes: Mapping[str, str],
) -> tuple[list[str], list[str]]:
    """Hashes of what the motions and the objects hold, whatever they are called.

    Of a motion: hand, rate, frames, roles, supports and the hashes of its objects.

    Args:
        entries: hand and fps, and ``parts`` and ``visual`` of each object.
        arrays: all arrays by name.
        meshes: hash of each mesh file.
    """
    objects = []
    for row, entry in enumerate(entries["objects"]):
        digest = hashlib.sha256()
        for key in OBJECT_KEYS:
            _add(digest, f"objects/{key}", arrays[f"objects/{key}"][row])
        files = [meshes[file] for file in (*entry["parts"], entry["visual"])]
        digest.update(json.dumps(files).encode())
        objects.append(digest.hexdigest())
    motions = []
    start, length = arrays["motions/start"], arrays["motions/length"]
    for row in range(len(start)):
        digest = hashlib.sha256(f"{entries['hand']} {float(entries['fps'])}".encode())
        span = slice(int(start[row]), int(start[row] + length[row]))
        for key in FRAME_KEYS:
            _add(digest, f"frames/{key}", arrays[f"frames/{key}"][span])
        for key in ("hand_active", "hand_object", "support_disks"):
            _add(digest, f"motions/{key}", arrays[f"motions/{key}"][row])
        index = arrays["motions/object_index"][row].tolist()
        own = [objects[i] if 0 <= i < len(objects) else None for i in index]
        digest.update(json.dumps(own).encode())
        motions.append(digest.hexdigest())
    return motions, objects


def _add(digest: Any, name: str, values: np.ndarray) -> None:
    digest.update(f"{name} {values.dtype} {values.shape}".encode())
    digest.update(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
