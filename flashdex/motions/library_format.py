"""What a motion library holds on disk: each array, each entry of its manifest.

Nothing in a library names code. ``manifest.json`` says which arrays and meshes there
are, with the hash of each; all of it is read as data and checked against this file.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from flashdex.errors import FlashdexError, LibraryError, RunError
from flashdex.keys import FINGERS, SIDES
from flashdex.system.arrays import ArrayEntry
from flashdex.system.files import open_plain
from flashdex.system.names import check_name, check_names
from flashdex.system.run_files import MANIFEST

SCHEMA = 2
MAX_MANIFEST = 32 << 20  # bytes; a thousand motions have about one million
MAX_PARTS = 256  # of an object
FPS_RANGE = (1.0, 10_000.0)  # 1/s
NUM_OBJECT_SLOTS = 2
CONVENTIONS = {
    "units": {"length": "m", "angle": "rad", "time": "s", "mass": "kg"},
    "up": "z",
    "quat": "wxyz",
    "hands": list(SIDES),
    "fingers": list(FINGERS),
}
AGAIN = "Prepare the library again: flashdex prepare"
# Type and shape of every array. F frames, M motions, Q objects, J joints of a hand, O
# object slots, S support discs, P points, R nodes of a distance grid along each axis.
ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "frames/joint_pos": ("float32", ("F", 2, "J")),
    "frames/joint_vel": ("float32", ("F", 2, "J")),
    "frames/wrist_pos": ("float32", ("F", 2, 3)),
    "frames/wrist_quat": ("float32", ("F", 2, 4)),
    "frames/wrist_linvel": ("float32", ("F", 2, 3)),
    "frames/wrist_angvel": ("float32", ("F", 2, 3)),
    "frames/keypoints": ("float32", ("F", 2, 21, 3)),
    "frames/keypoint_linvel": ("float32", ("F", 2, 21, 3)),
    "frames/tip_dist": ("float32", ("F", 2, 5)),
    "frames/object_pos": ("float32", ("F", "O", 3)),
    "frames/object_quat": ("float32", ("F", "O", 4)),
    "frames/object_linvel": ("float32", ("F", "O", 3)),
    "frames/object_angvel": ("float32", ("F", "O", 3)),
    "quality/tip_error": ("float32", ("F", 2, 5)),
    "quality/penetration": ("float32", ("F",)),
    "quality/contact": ("bool", ("F", 2, 5)),
    "motions/start": ("int64", ("M",)),
    "motions/length": ("int64", ("M",)),
    "motions/hand_active": ("bool", ("M", 2)),
    "motions/hand_object": ("int64", ("M", 2)),
    "motions/object_index": ("int64", ("M", "O")),
    "motions/support_disks": ("float32", ("M", "S", 5)),
    "objects/points": ("float32", ("Q", "P", 3)),
    "objects/normals": ("float32", ("Q", "P", 3)),
    "objects/radius": ("float32", ("Q",)),
    "objects/sdf": ("float32", ("Q", "R", "R", "R")),
    "objects/sdf_origin": ("float32", ("Q", 3)),
    "objects/sdf_spacing": ("float32", ("Q",)),
    "objects/mass": ("float32", ("Q",)),
    "objects/com": ("float32", ("Q", 3)),
    "objects/inertia": ("float32", ("Q", 3, 3)),
    "objects/aabb": ("float32", ("Q", 2, 3)),
}


def _keys(part: str) -> tuple[str, ...]:
    return tuple(n.removeprefix(part) for n in ARRAYS if n.startswith(part))


FRAME_KEYS, OBJECT_KEYS = _keys("frames/"), _keys("objects/")
# How good the reference is, frame by frame; for reports, no training reads it.
QUALITY_KEYS = _keys("quality/")
_DATA = re.compile(r"data-[0-9a-f]{16}")
_HASH = re.compile(r"[0-9a-f]{64}")
# of a stem, see ``system.names``
_MESH = re.compile(r"meshes/[\w@+()][\w@+().-]{0,120}/[a-z0-9_]{1,40}\.obj", re.ASCII)


class OldLibraryError(LibraryError):
    """A library of an earlier schema, which this version does not read."""


@dataclass(frozen=True)
class Manifest:
    """A manifest that was checked against the schema."""

    entries: dict[str, Any]  # as written
    data: str  # folder of the arrays and meshes, below the library
    arrays: dict[str, ArrayEntry]
    meshes: dict[str, str]  # path below ``data`` to SHA-256
    sha256: str  # of all it says, and so of all the library holds

    @property
    def seed(self) -> int:
        """Of what is drawn to check the library; the same for the same content."""
        return int(self.sha256[:15], 16)

    def names(self, part: Literal["motions", "objects"]) -> list[str]:
        """Names of the motions or objects, in row order."""
        return [row["name"] for row in self.entries[part]]


def read_manifest(path: Path) -> Manifest:
    """Read and check ``manifest.json`` of a library.

    Raises:
        LibraryError: it is missing, damaged, too large or of another schema.
    """
    file = path / MANIFEST
    try:
        with open_plain(file) as stream:
            text = stream.read(MAX_MANIFEST + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise LibraryError(
            f"{path} is not a motion library: no manifest.json in {path.absolute()}. "
            "Where it lies elsewhere, name its folder: motions.library=DIR. Or make "
            "one: flashdex prepare --source ... --out DIR"
        ) from None
    except (OSError, ValueError) as error:
        raise LibraryError(f"{file}: cannot be read ({error}). {AGAIN}") from error
    if len(text) > MAX_MANIFEST:
        raise LibraryError(f"{file}: over {MAX_MANIFEST >> 20} MiB. {AGAIN}")
    try:
        return parse_manifest(json.loads(text.decode("utf-8")))
    except OldLibraryError as error:
        raise OldLibraryError(f"{path}: {error}") from None
    except (ValueError, RecursionError, FlashdexError) as error:
        kind = "not JSON, " if isinstance(error, json.JSONDecodeError) else ""
        raise LibraryError(
            f"{file}: {kind}{error} It was damaged or changed. {AGAIN}"
        ) from error


def parse_manifest(entries: Any) -> Manifest:
    """Check the entries of a manifest.

    Raises:
        LibraryError: one is not as ``LibraryWriter`` writes it.
    """
    if not isinstance(entries, dict):
        raise LibraryError("not a JSON object.")
    if entries.get("schema") != SCHEMA or type(entries["schema"]) is not int:
        raise OldLibraryError(
            f"schema {entries.get('schema')!r:.20}, this version reads {SCHEMA}. "
            f"{AGAIN} (motions in the cache are not computed again)."
        )
    for key, value in CONVENTIONS.items():
        if entries.get(key) != value:
            raise LibraryError(f"'{key}' is {entries.get(key)!r:.80}, not {value!r}.")
    check_name(entries.get("hand"), what="hand")
    _check_fps(entries.get("fps"))
    _check_facts(entries)
    data = entries.get("data")
    if not isinstance(data, str) or not _DATA.fullmatch(data):
        raise LibraryError(f"'data' is {data!r:.80}, no folder of a library.")
    meshes = _parse_meshes(entries.get("meshes"))
    arrays = _parse_arrays(entries)
    digest = hash_json({k: v for k, v in entries.items() if k != "data"})
    return Manifest(entries, data, arrays, meshes, digest)


def _check_fps(fps: Any) -> None:
    low, high = FPS_RANGE
    if type(fps) not in (int, float) or not low <= fps <= high:
        raise LibraryError(f"'fps' is {fps!r:.40}; allowed are {low:g} to {high:g}.")


def _check_facts(entries: Mapping[str, Any]) -> None:
    """What reports show and runs compare; everything else is carried along."""
    versions = entries.get("versions", {})
    is_text = isinstance(versions, dict) and all(
        isinstance(v, str) for v in versions.values()
    )
    if not is_text or not isinstance(entries.get("inputs", ""), str):
        raise LibraryError("'versions' or 'inputs' is of another type than text.")


def _parse_meshes(meshes: Any) -> dict[str, str]:
    if not isinstance(meshes, dict):
        raise LibraryError("'meshes' is missing.")
    for name, digest in meshes.items():
        if not _MESH.fullmatch(name) or not is_hash(digest):
            raise LibraryError(f"{name!a:.100} is no mesh of a library.")
    return meshes


def is_hash(value: Any) -> bool:
    """Whether a value is a SHA-256 as hex digits."""
    return isinstance(value, str) and _HASH.fullmatch(value) is not None


def _parse_arrays(entries: Mapping[str, Any]) -> dict[str, ArrayEntry]:
    found = entries.get("arrays")
    if not isinstance(found, dict):
        raise LibraryError("'arrays' is missing.")
    quality = {name for name in ARRAYS if name.startswith("quality/")}
    missing = sorted(set(ARRAYS) - quality - set(found))
    if quality & set(found):
        missing += sorted(quality - set(found))
    if missing or set(found) - set(ARRAYS):
        odd = sorted(set(found) - set(ARRAYS))
        raise LibraryError(
            f"arrays {', '.join(missing) or 'none'} are missing, "
            f"{', '.join(f'{name!a:.60}' for name in odd[:5]) or 'none'} are unknown."
        )
    motions = _names(entries, "motions")
    sizes = {"M": len(motions), "Q": len(_names(entries, "objects"))}
    arrays = {}
    for name, (dtype, shape) in ARRAYS.items():
        if name in found:
            arrays[name] = entry = _parse_array(name, found[name], dtype)
            _match(name, entry.shape, shape, sizes)
    _check_rows(entries)
    return arrays


def _parse_array(name: str, entry: Any, dtype: str) -> ArrayEntry:
    try:
        parsed = ArrayEntry.parse(entry)
    except ValueError as error:
        raise LibraryError(f"'{name}': {error}.") from error
    if parsed.dtype != dtype or not is_hash(parsed.sha256):
        raise LibraryError(f"'{name}' is of {parsed.dtype}, not {dtype}, or unhashed.")
    return parsed


def _match(
    name: str, found: tuple[int, ...], shape: tuple[str | int, ...], sizes: dict
) -> None:
    """Compare a shape with the declared one; the first use of a letter sets it."""
    if len(found) == len(shape):
        wanted = tuple(
            size if isinstance(size, int) else sizes.setdefault(size, found[i])
            for i, size in enumerate(shape)
        )
        if found == wanted and 0 not in found:
            return
    words = ", ".join(map(str, shape))
    raise LibraryError(f"'{name}' has shape {found}, not ({words}) with {sizes}.")


def _names(entries: Mapping[str, Any], part: str) -> list[str]:
    rows = entries.get(part)
    if not isinstance(rows, list) or not all(isinstance(r, dict) for r in rows):
        raise LibraryError(f"'{part}' is not a list of entries.")
    if not rows:
        raise LibraryError(f"'{part}' is empty.")
    return check_names([row.get("name") for row in rows], what=part.removesuffix("s"))


def _check_rows(entries: Mapping[str, Any]) -> None:
    for row in (*entries["motions"], *entries["objects"]):
        if not is_hash(row.get("content_sha256")):
            raise LibraryError(f"{row['name']!a} has no 'content_sha256'.")
    for row in entries["objects"]:
        parts = row.get("parts")
        files = [*parts, row.get("visual")] if isinstance(parts, list) else []
        is_listed = all(isinstance(f, str) and f in entries["meshes"] for f in files)
        if not is_listed or not 2 <= len(set(files)) == len(files) <= MAX_PARTS + 1:
            raise LibraryError(
                f"object {row['name']!a}: its meshes are not listed, or not once each, "
                f"or it has over {MAX_PARTS} parts."
            )
        if not isinstance(row.get("watertight"), bool):
            raise LibraryError(f"object {row['name']!a}: 'watertight' is no bool.")


def hash_json(value: Any) -> str:
    """SHA-256 of a value as JSON, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


@contextmanager
def as_library_error(hint: str = AGAIN) -> Iterator[None]:
    """A library's files are a run's files but for the error."""
    try:
        yield
    except RunError as error:
        raise LibraryError(f"{error} {hint}".strip()) from error
