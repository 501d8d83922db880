"""The motion library: all motions of a collection, memory-mapped on one frame axis."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from tensordict import TensorDict

from flashdex.errors import LibraryError, nearest

SCHEMA = 1
NUM_OBJECT_SLOTS = 2
FRAME_KEYS = (
    *("joint_pos", "joint_vel"),
    *("wrist_pos", "wrist_quat", "wrist_linvel", "wrist_angvel"),
    *("keypoints", "keypoint_linvel", "tip_dist"),
    *("object_pos", "object_quat", "object_linvel", "object_angvel"),
)
# How good the reference is, frame by frame; for reports, no training reads it.
QUALITY_KEYS = ("tip_error", "penetration", "contact")


@dataclass
class MotionLibrary:
    """Reference motions of one collection, never padded over time, never copied.

    ``frames`` (F,), ``motions`` (M,) and ``objects`` (Q,) are memory-mapped; motion
    ``m`` owns the rows ``start[m] ... start[m] + length[m] - 1`` of ``frames``.

    ``quality`` has a row a frame: ``tip_error`` (2, 5), m, robot pad to human tip;
    ``penetration`` (), m, deepest contact of a hand with an object; ``contact`` (2, 5),
    human fingers in contact. It is None in older libraries.

    Example:
        >>> library = MotionLibrary.load("libraries/quickstart")  # doctest: +SKIP
        >>> frame = library.at(torch.tensor([0]), torch.tensor([12]))  # doctest: +SKIP
    """

    path: Path
    frames: TensorDict
    motions: TensorDict
    objects: TensorDict
    manifest: dict[str, Any]  # names, sources, licences, hashes, versions
    quality: TensorDict | None = None

    @classmethod
    def load(cls, path: str | Path) -> MotionLibrary:
        """Open a directory that ``prepare`` wrote.

        Raises:
            LibraryError: if it is missing, incomplete or of another schema.
        """
        path = Path(path)
        manifest = _read_manifest(path)
        parts = {}
        for part in ("frames", "motions", "objects", "quality"):
            if (path / part / "meta.json").is_file():
                parts[part] = TensorDict.load_memmap(path / part)
            elif part != "quality":
                raise LibraryError(
                    f"{path}: '{part}' is missing. Prepare it again: flashdex prepare"
                )
        library = cls(path=path, manifest=manifest, **parts)
        library._check()
        return library

    def _check(self) -> None:
        missing = sorted(set(FRAME_KEYS) - set(self.frames.keys()))
        if missing:
            raise LibraryError(f"{self.path}: frames lack {', '.join(missing)}.")
        total = int(self.motions["length"].sum())
        if total != len(self.frames) or len(self.names) != self.num_motions:
            raise LibraryError(
                f"{self.path}: {total} frames of {self.num_motions} motions announced, "
                f"{len(self.frames)} frames of {len(self.names)} found."
            )

    @property
    def num_motions(self) -> int:
        """Number of motions M."""
        return len(self.motions)

    @property
    def names(self) -> list[str]:
        """Names of the motions, in row order."""
        return [m["name"] for m in self.manifest["motions"]]

    @property
    def fps(self) -> float:
        """Frames a second of all motions: the control rate."""
        return float(self.manifest["fps"])

    @property
    def hand(self) -> str:
        """Name of the robot hand that the joint references are for."""
        return self.manifest["hand"]

    def row(self, name: str) -> int:
        """Row of the motion called ``name``."""
        if name not in self.names:
            raise LibraryError(
                f"{self.path}: no motion '{name}'.{nearest(name, self.names)}"
            )
        return self.names.index(name)

    def index(self, motion: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
        """Rows of ``frames``, int64, (...): start + clamp(frame, 0, length - 1)."""
        start, length = self.motions["start"][motion], self.motions["length"][motion]
        return start + torch.minimum(frame.clamp_min(0), length - 1)

    def at(self, motion: torch.Tensor, frame: torch.Tensor) -> TensorDict:
        """Frames of motions, gathered; batch size of the broadcast arguments."""
        return self.frames[self.index(motion, frame)]

    def parts(self, object_row: int) -> list[np.ndarray]:
        """Convex parts of an object: vertices (V, 3), m, object frame, float32."""
        entry = self.manifest["objects"][object_row]
        return [_read_vertices(self.path / file) for file in entry["parts"]]

    def visual(self, object_row: int) -> trimesh.Trimesh:
        """Visual mesh of an object, m, object frame."""
        file = self.path / self.manifest["objects"][object_row]["visual"]
        return trimesh.load_mesh(file, process=False)


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / "manifest.json"
    if not file.is_file():
        raise LibraryError(
            f"{path} is not a motion library: no manifest.json. "
            f"Make one: flashdex prepare --source ... --out {path}"
        )
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise LibraryError(f"{file}: not JSON ({error}).") from error
    if manifest.get("schema") != SCHEMA:
        raise LibraryError(
            f"{path}: schema {manifest.get('schema')}, this version reads {SCHEMA}. "
            f"Prepare it again."
        )
    return manifest


def _read_vertices(file: Path) -> np.ndarray:
    if not file.is_file():
        raise LibraryError(f"{file} is missing. Prepare the library again.")
    lines = file.read_text(encoding="ascii").splitlines()
    rows = [line.split()[1:4] for line in lines if line.startswith("v ")]
    return np.asarray(rows, dtype=np.float32)
