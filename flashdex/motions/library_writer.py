"""Writes a motion library in one step: complete, or not at all."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from tensordict import TensorDict

from flashdex.errors import LibraryError
from flashdex.keys import FINGERS, SIDES
from flashdex.motions.library import (
    FRAME_KEYS,
    QUALITY_KEYS,
    SCHEMA,
)
from flashdex.objects.asset import ObjectAsset

# what is no part of the name of a folder, and how long one may be
NO_NAME, NAME_LENGTH = re.compile(r"[^\w @+.()-]+"), 60
OBJECT_KEYS = ("points", "normals", "radius", "sdf", "sdf_origin", "sdf_spacing")
OBJECT_KEYS += ("mass", "com", "inertia", "aabb")
CONVENTIONS = {
    "units": {"length": "m", "angle": "rad", "time": "s", "mass": "kg"},
    "up": "z",
    "quat": "wxyz",
    "hands": list(SIDES),
    "fingers": list(FINGERS),
}


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

    Everything is written to a temporary folder beside the target and renamed at the
    end, so that a killed run leaves no library and an old one stays as it was. The
    manifest may be given more entries (settings, versions, source).
    """

    def __init__(
        self, path: str | Path, *, hand: str, fps: float, manifest: dict | None = None
    ) -> None:
        self.path = Path(path)
        self._manifest = {"schema": SCHEMA, **CONVENTIONS, "hand": hand, "fps": fps}
        self._manifest |= manifest or {}
        self._records: list[MotionRecord] = []
        self._objects: dict[str, ObjectAsset] = {}

    def add(self, record: MotionRecord) -> None:
        """Add one motion; objects that are equal are stored once."""
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
        """Write the library, with ``report`` as report.csv; replaces one of its name.

        Raises:
            LibraryError: when there is nothing to write or the disk refuses; nothing
                is left behind then.
        """
        if not self._records:
            raise LibraryError(f"{self.path}: no motion was kept; nothing to write.")
        name, folder = self.path.name, self.path.parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(
                prefix=f".{name}-", dir=folder, ignore_cleanup_errors=True
            ) as work:
                self._fill(Path(work), report)
                _swap(Path(work), self.path)
        except (OSError, RuntimeError) as error:
            raise LibraryError(
                f"{self.path}: could not write the library ({error}). Check free "
                f"space and permissions of {folder}."
            ) from error
        return self.path

    def _fill(self, work: Path, report: str) -> None:
        os.chmod(work, 0o755)  # mkdtemp makes it private
        assets = list(self._objects.values())
        names = _unique_names(assets)
        files = [_write_meshes(work, *pair) for pair in zip(names, assets, strict=True)]
        tables = {
            "frames": self._stack_rows("frames", FRAME_KEYS).float(),
            "motions": self._stack_motions(),
            "objects": _stack_objects(assets),
        }
        if all(r.quality for r in self._records):
            tables["quality"] = self._stack_rows("quality", QUALITY_KEYS)
        # Writing to a mapped file on a full disk kills the process: ask beforehand.
        needed = sum(table.bytes() for table in tables.values())
        free = shutil.disk_usage(work).free
        if needed > free:
            raise OSError(
                errno.ENOSPC, f"{needed / 1e6:.1f} MB needed, {free / 1e6:.1f} MB free"
            )
        for name, table in tables.items():
            table.memmap(str(work / name))
        manifest = self._manifest | {
            "motions": [{"name": r.name, **r.info} for r in self._records],
            "objects": [
                {"name": n, "sha256": a.sha256, "watertight": bool(a.watertight), **f}
                for n, a, f in zip(names, assets, files, strict=True)
            ],
        }
        # names of files and texts in them may hold what is no character
        told = report.encode("utf-8", errors="backslashreplace")
        (work / "report.csv").write_bytes(told)
        text = json.dumps(manifest, indent=1)
        (work / "manifest.json").write_text(text, encoding="utf-8")

    def _stack_rows(self, part: str, keys: Iterable[str]) -> TensorDict:
        """Frames of all motions on one axis."""
        rows = [getattr(record, part) for record in self._records]
        columns = {k: np.concatenate([row[k] for row in rows]) for k in keys}
        tensors = {k: torch.as_tensor(v) for k, v in columns.items()}
        return TensorDict(tensors).auto_batch_size_(1)

    def _stack_motions(self) -> TensorDict:
        lengths = torch.tensor([len(r.frames["joint_pos"]) for r in self._records])
        rows = {sha: i for i, sha in enumerate(self._objects)}
        slots = self._records[0].frames["object_pos"].shape[1]
        index = torch.full((len(self._records), slots), -1)
        for i, record in enumerate(self._records):
            for slot, asset in enumerate(record.objects):
                index[i, slot] = rows[asset.sha256]
        disks = np.stack([r.support_disks for r in self._records])
        return TensorDict(
            {
                "start": lengths.cumsum(0) - lengths,
                "length": lengths,
                "hand_active": torch.tensor([r.hand_active for r in self._records]),
                "hand_object": torch.tensor([r.hand_object for r in self._records]),
                "object_index": index,
                "support_disks": torch.as_tensor(disks).float(),
            },
            batch_size=[len(self._records)],
        )


def _stack_objects(assets: list[ObjectAsset]) -> TensorDict:
    stacked = {
        key: torch.as_tensor(np.stack([getattr(a, key) for a in assets])).float()
        for key in OBJECT_KEYS
    }
    return TensorDict(stacked, batch_size=[len(assets)])


def _unique_names(assets: list[ObjectAsset]) -> list[str]:
    """Names of folders: a dataset may call its objects anything, "../x" as well."""
    names: dict[str, None] = {}
    for asset in assets:
        plain = NO_NAME.sub("_", asset.name).lstrip(".")[:NAME_LENGTH] or "object"
        name, count = plain, 1
        while name in names:
            count += 1
            name = f"{plain}_{count}"
        names[name] = None
    return list(names)


def _write_meshes(work: Path, name: str, asset: ObjectAsset) -> dict[str, Any]:
    folder = Path("meshes") / name
    (work / folder).mkdir(parents=True)
    parts = []
    for i, part in enumerate(asset.parts):
        file = folder / f"part_{i:03d}.obj"
        hull = trimesh.convex.convex_hull(part)
        # its faces, of the part's vertices in the order that they have
        gaps = np.linalg.norm(hull.vertices[:, None] - part[None], axis=-1)
        _write_obj(work / file, part, gaps.argmin(axis=1)[hull.faces])
        parts.append(str(file))
    visual = folder / "visual.obj"
    _write_obj(work / visual, asset.visual_vertices, asset.visual_faces)
    return {"parts": parts, "visual": str(visual)}


def _write_obj(file: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(vertices)]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    file.write_text("\n".join(lines) + "\n", encoding="ascii")


def _swap(work: Path, target: Path) -> None:
    """Put ``work`` in the place of ``target``; the old one is kept until it stands."""
    old = None
    if target.exists():
        if not (target / "manifest.json").is_file():
            raise LibraryError(
                f"{target} exists and is not a motion library; it is not replaced."
            )
        old = target.with_name(f".{target.name}-old-{os.getpid()}")
        os.replace(target, old)
    try:
        os.replace(work, target)
    except OSError:
        if old is not None:
            os.replace(old, target)
        raise
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)
