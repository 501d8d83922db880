"""Writes a motion library in one step: complete, or not at all."""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import LibraryError
from flashdex.motions.library_check import (
    check_all,
    check_once,
    hash_rows,
    map_arrays,
)
from flashdex.motions.library_format import (
    ARRAYS,
    CONVENTIONS,
    FRAME_KEYS,
    MANIFEST,
    MAX_MANIFEST,
    OBJECT_KEYS,
    QUALITY_KEYS,
    SCHEMA,
    as_library_error,
    parse_manifest,
    read_manifest,
)
from flashdex.motions.library_meshes import write_meshes
from flashdex.objects.asset import ObjectAsset
from flashdex.system.arrays import write_array
from flashdex.system.files import open_plain, own_file, waiting_lock, write_atomic
from flashdex.system.names import check_name, file_stem

# what is no part of the name of an object, and how long one may be
NO_NAME, NAME_LENGTH = re.compile(r"[^\w @+.()-]+"), 60
# folders of a library's data, the one that is being written too
DATA = re.compile(r"\.?data-[0-9a-f]{16}")
TEMPORARY = re.compile(r"\.(manifest\.json|report\.html)\.\d+\.tmp")
OF_THE_DISK = (".DS_Store", "Thumbs.db", "lost+found")  # a folder is empty all the same
LOCK, REPORT, PAGE = ".library.lock", "report.csv", "report.html"
# what schema 1 kept beside its manifest
OLD_PARTS = ("frames", "motions", "objects", "quality", "meshes")


@dataclass
class MotionRecord:
    """One prepared motion, as it goes into the library."""

    name: str  # unique in the library
    frames: dict[str, np.ndarray]  # every key of FRAME_KEYS, (T, ...)
    hand_active: tuple[bool, bool]  # which hands take part, [left, right]
    hand_object: tuple[int, int]  # object slot of each hand, -1 for none
    objects: list[ObjectAsset]  # by slot; at most as many as there are slots
    support_disks: np.ndarray  # [x, y, z_top, radius, height], m, NaN unused, (4, 5)
    # what the manifest says about it: source, licence, status, figures
    info: dict[str, Any] = field(default_factory=dict)
    # every key of QUALITY_KEYS, (T, ...), or nothing
    quality: dict[str, np.ndarray] = field(default_factory=dict)


class LibraryWriter:
    """Collects motions and writes them as one library directory.

    All data goes to a new folder in the library; renaming ``manifest.json``, which
    names that folder, is the step that puts it in place. A killed run leaves no
    library, or the one that was there. The folder itself stays the same: it may be a
    link, a mount point or the working directory.

    The manifest may be given more entries (settings, versions, source).

    Raises:
        LibraryError: something else is in the place of the library.
    """

    def __init__(
        self, path: str | Path, *, hand: str, fps: float, manifest: dict | None = None
    ) -> None:
        self.path = Path(path)
        own = {"schema": SCHEMA, **CONVENTIONS, "hand": hand, "fps": float(fps)}
        self._manifest = (manifest or {}) | own
        self._records: list[MotionRecord] = []
        self._objects: dict[str, ObjectAsset] = {}
        check_target(self.path)

    def add(self, record: MotionRecord) -> None:
        """Add one motion; objects that are equal are stored once."""
        check_name(record.name, what="motion", where=str(self.path))
        missing = [k for k in FRAME_KEYS if k not in record.frames]
        lengths = {len(v) for v in record.frames.values()}
        if missing or len(lengths) != 1:
            raise LibraryError(
                f"{record.name}: frames lack {missing} or differ in length {lengths}."
            )
        if record.name in {r.name for r in self._records}:
            raise LibraryError(f"two motions are called '{record.name}'.")
        # equal objects become one, or a large collection does not fit into memory
        record.objects = [
            self._objects.setdefault(asset.sha256, asset) for asset in record.objects
        ]
        self._records.append(record)

    def write(self, *, report: str = "") -> Path:
        """Write the library, with ``report`` as report.csv; replaces what is there.

        Raises:
            LibraryError: there is nothing to write, something of it is no motion, or
                the disk refuses; the library that was there is whole then.
        """
        if not self._records:
            raise LibraryError(f"{self.path}: no motion was kept; nothing to write.")
        check_target(self.path)
        # exists of os: what no path can be, over-long or with NUL, is not there
        is_new = not os.path.exists(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            check_target(self.path)  # 'new/../old' leads there only now
            with waiting_lock(self.path / "library"):
                self._replace(report)
        except OSError as error:
            raise LibraryError(
                f"{self.path}: could not write the library ({error}). Check free "
                f"space and permissions of {self.path.absolute().parent}."
            ) from error
        finally:
            if is_new and not os.path.exists(self.path / MANIFEST):
                _remove_empty(self.path)
        return self.path

    def _replace(self, report: str) -> None:
        data, is_old = f"data-{secrets.token_hex(8)}", _is_old(self.path)
        work = self.path / f".{data}"
        try:
            work.mkdir()
            manifest = self._fill(work) | {"data": data}
            # names of files and texts in them may hold what is no character
            told = report.encode("utf-8", errors="backslashreplace")
            (work / REPORT).write_bytes(told)
            # runs of a sweep prepare the same and read what is there already
            parsed = parse_manifest(manifest)
            if _is_whole(self.path, parsed.sha256):
                os.replace(work / REPORT, self.path / REPORT)
                return
            os.replace(work, self.path / data)
            # what is written can be opened, or the old one stays
            arrays = map_arrays(self.path, parsed)
            check_once(self.path, parsed, arrays, refusal="is not written")
            write_atomic(self.path / MANIFEST, json.dumps(manifest, indent=1))
            # what needs room on the disk is done: from here on nothing can be lost
            os.replace(self.path / data / REPORT, self.path / REPORT)
        finally:
            # what this or a killed writer left, or the library before
            _clean(self.path, parts=OLD_PARTS if is_old else ())

    def _fill(self, work: Path) -> dict[str, Any]:
        """Write all data; return the manifest, but for the name of its folder."""
        objects, meshes = self._write_objects(work)
        arrays = self._stack()
        motions = [{**r.info, "name": r.name} for r in self._records]
        manifest = self._manifest | {"motions": motions, "objects": objects}
        hashes = hash_rows(manifest, arrays, meshes)
        for rows, digests in zip((motions, objects), hashes, strict=True):
            for row, digest in zip(rows, digests, strict=True):
                row["content_sha256"] = digest
        for part in dict.fromkeys(name.split("/")[0] for name in arrays):
            (work / part).mkdir()
        written = {n: write_array(work / f"{n}.npy", a) for n, a in arrays.items()}
        manifest["meshes"] = meshes
        manifest["arrays"] = {name: e.to_dict() for name, e in written.items()}
        return json.loads(json.dumps(manifest))

    def _write_objects(self, work: Path) -> tuple[list[dict], dict[str, str]]:
        """Write all meshes; return entries of the objects, and hashes of the files."""
        assets = list(self._objects.values())
        entries, meshes = [], {}
        for name, asset in zip(_unique_names(assets), assets, strict=True):
            files, hashes = write_meshes(work, name, asset)
            told = {"sha256": asset.sha256, "watertight": bool(asset.watertight)}
            entries.append({"name": name, **told, **files})
            meshes |= hashes
        return entries, meshes

    def _stack(self) -> dict[str, np.ndarray]:
        """All arrays of the library, each of its declared type."""
        assets = self._objects.values()
        columns = {
            f"objects/{key}": np.stack([getattr(asset, key) for asset in assets])
            for key in OBJECT_KEYS
        }
        tables = {"frames": FRAME_KEYS}
        if all(r.quality for r in self._records):
            tables["quality"] = QUALITY_KEYS
        for part, keys in tables.items():
            rows = [getattr(record, part) for record in self._records]
            for key in keys:
                columns[f"{part}/{key}"] = np.concatenate([row[key] for row in rows])
        columns |= self._stack_motions()
        return {k: np.asarray(v, ARRAYS[k][0]) for k, v in columns.items()}

    def _stack_motions(self) -> dict[str, np.ndarray]:
        records = self._records
        lengths = np.array([len(r.frames["joint_pos"]) for r in records])
        rows = {sha: i for i, sha in enumerate(self._objects)}
        slots = records[0].frames["object_pos"].shape[1]
        index = np.full((len(records), slots), -1)
        for i, record in enumerate(records):
            for slot, asset in enumerate(record.objects):
                index[i, slot] = rows[asset.sha256]
        return {
            "motions/start": lengths.cumsum() - lengths,
            "motions/length": lengths,
            "motions/hand_active": np.array([r.hand_active for r in records]),
            "motions/hand_object": np.array([r.hand_object for r in records]),
            "motions/object_index": index,
            "motions/support_disks": np.stack([r.support_disks for r in records]),
        }


def _unique_names(assets: list[ObjectAsset]) -> list[str]:
    """Names of objects that can be shown and stored: a dataset may say "../x"."""
    names: dict[str, str] = {}
    for asset in assets:
        plain = NO_NAME.sub("_", asset.name).lstrip(".")[:NAME_LENGTH].strip()
        plain = plain or "object"
        name, count = plain, 1
        while file_stem(name).casefold() in names:
            count += 1
            name = f"{plain}_{count}"
        names[file_stem(name).casefold()] = name
    return list(names.values())


def check_target(path: Path) -> None:
    """Refuse a folder that no library may be written to, before the work.

    Raises:
        LibraryError: it holds other files, is none, or cannot be written.
    """
    if "\0" in str(path):
        raise LibraryError(f"{str(path)!a}: cannot be a path.")
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:  # a name that is too long
        raise LibraryError(f"{path}: cannot be a path ({error.strerror}).") from error
    folder = path
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        kind = "a link to nothing" if folder.is_symlink() else "not a folder"
        raise LibraryError(f"{path}: could not write the library: {folder} is {kind}.")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise LibraryError(
            f"{path}: could not write the library: {folder} refuses ({error.strerror})."
        ) from error
    if folder is path:
        with as_library_error(hint=""):
            for name in (REPORT, PAGE):
                own_file(path, name)
        held = [n for n in os.listdir(path) if n not in (LOCK, *OF_THE_DISK)]
        ours = [n for n in held if DATA.fullmatch(n) or TEMPORARY.fullmatch(n)]
        if len(ours) < len(held) and not _is_library(path):
            raise LibraryError(
                f"{path} exists and is not a motion library; it is not replaced. Name "
                "another folder, or empty this one."
            )


def _is_folder(path: Path) -> bool:
    """Whether it is a folder itself, no link to one."""
    return path.is_dir() and not path.is_symlink()


def _is_library(path: Path) -> bool:
    """Whether the manifest is one of a library, of any version and in any state."""
    if (entries := _read_old(path)) is not None:
        return isinstance(entries, dict) and {"schema", "motions"} <= set(entries)
    # a damaged one is replaced where its data is there
    is_manifest = (path / MANIFEST).is_file()
    return is_manifest and any(DATA.fullmatch(name) for name in os.listdir(path))


def _read_old(path: Path) -> Any:
    """The manifest that is there; None where there is none that can be read."""
    with (
        suppress(OSError, ValueError, RecursionError),
        open_plain(path / MANIFEST) as f,
    ):
        return json.loads(f.read(MAX_MANIFEST).decode("utf-8"))
    return None


def _is_whole(path: Path, sha256: str) -> bool:
    """Whether a library of this hash is there, and nothing in it is damaged."""
    try:
        found = read_manifest(path)
        if found.sha256 != sha256:
            return False
        return not check_all(path, found, map_arrays(path, found))
    except LibraryError:
        return False


def _is_old(path: Path) -> bool:
    entries = _read_old(path)
    return isinstance(entries, dict) and entries.get("schema") == 1


def _clean(path: Path, *, parts: tuple[str, ...]) -> None:
    """Remove data that the manifest does not name, by the names that writers give."""
    entries = _read_old(path)
    keep = entries.get("data") if isinstance(entries, dict) else None
    is_told = isinstance(keep, str) or not os.path.lexists(path / MANIFEST)
    if not is_told:  # it cannot be read at the moment: all might be needed
        return
    for name in os.listdir(path):
        if name != keep and (DATA.fullmatch(name) or name in parts):
            # folders only: of a pipe it would wait for a writer
            if _is_folder(path / name):
                shutil.rmtree(path / name, ignore_errors=True)
        elif TEMPORARY.fullmatch(name):
            with suppress(OSError):
                (path / name).unlink()


def _remove_empty(path: Path) -> None:
    with suppress(OSError):
        (path / LOCK).unlink(missing_ok=True)
        path.rmdir()
