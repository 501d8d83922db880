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

from flashdex.errors import FlashdexError, LibraryError
from flashdex.motions.library_format import (
    FRAME_KEYS,
    OBJECT_KEYS,
    Manifest,
    as_library_error,
    hash_json,
    is_hash,
)
from flashdex.motions.library_meshes import Mesh, read_mesh
from flashdex.motions.library_numbers import (
    find_faults,
    grid_fault,
    part_fault,
    parts_fault,
)
from flashdex.objects.asset import default_cache_dir
from flashdex.system.arrays import hash_content, map_array
from flashdex.system.files import own_file

Arrays = Mapping[str, np.ndarray]
CHECK_VERSION = 2  # raise when a library is checked for more
MAX_MARKS = 1000  # libraries that are remembered
MAX_FAULTS = 100  # that are told; a library of more is another one


def _changes(path: Path, manifest: Manifest, arrays: Arrays) -> Iterator[str]:
    """Files that are not those of the manifest, and meshes that are no bodies."""
    for name, entry in manifest.arrays.items():
        with as_library_error():
            file = own_file(path, manifest.data, f"{name}.npy")
        if hash_content(file) != entry.sha256:
            yield f"{name}: was changed; its hash is not that of the manifest"
    bodies: dict[str, Mesh] = {}
    for name, digest in manifest.meshes.items():
        try:
            bodies[name] = read_mesh(path, manifest.data, name, digest)
        except LibraryError as error:
            yield str(error)
    for row, entry in enumerate(manifest.entries["objects"]):
        body = {key: arrays[f"objects/{key}"][row] for key in OBJECT_KEYS}
        for file in entry["parts"]:
            if file in bodies and (fault := part_fault(bodies[file][0], body["aabb"])):
                yield f"{file}: {fault}"
        if all(file in bodies for file in (*entry["parts"], entry["visual"])):
            parts = [bodies[file][0] for file in entry["parts"]]
            fault = parts_fault(parts, body["aabb"])
            mesh = bodies[entry["visual"]]
            if fault := fault or grid_fault(body, mesh, manifest.seed + row):
                yield f"object {entry['name']!a}: {fault}"
    if len(bodies) == len(manifest.meshes):
        yield from _exchanged(manifest, arrays)


def _exchanged(manifest: Manifest, arrays: Arrays) -> Iterator[str]:
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


def check_once(path: Path, manifest: Manifest, arrays: Arrays, *, refusal: str) -> None:
    """Check a library unless these very files were found to be whole before.

    Raises:
        LibraryError: something is wrong in it: ``refusal``, and what and where it is.
    """
    mark = _mark(path, manifest)
    if mark is not None and mark.is_file():
        return
    faults = check_all(path, manifest, arrays)
    if faults:
        told = faults[:5] + [f"and {len(faults) - 5} more"] * (len(faults) > 5)
        raise LibraryError("\n  ".join([f"{path}: {refusal}", *told]))
    if mark is not None and mark == _mark(path, manifest):  # nobody wrote meanwhile
        with suppress(OSError):  # without a cache it is checked again
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()
            _forget_old(mark.parent)


def _forget_old(folder: Path) -> None:
    """Libraries come and go; the newest marks are enough."""
    marks = [mark for mark in folder.iterdir() if is_hash(mark.name)]
    if len(marks) > MAX_MARKS:
        marks.sort(key=lambda mark: mark.stat().st_mtime_ns)
        for mark in marks[: -MAX_MARKS // 2]:
            mark.unlink(missing_ok=True)


def check_all(path: Path, manifest: Manifest, arrays: Arrays) -> list[str]:
    """Every fault of a library: of its numbers, then of its files."""
    faults = []
    with np.errstate(all="ignore"):  # numbers of any kind are expected here
        for look in (find_faults(manifest, arrays), _changes(path, manifest, arrays)):
            try:
                # one by one: what was found before an error counts
                for fault in look:
                    faults.append(fault)
                    if len(faults) >= MAX_FAULTS:
                        return [*faults, "and no more was looked at"]
            except (LibraryError, OSError) as error:
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
    except (OSError, FlashdexError):  # a file is missing, or there is no home
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
