"""The motion library: all motions of a collection, memory-mapped on one frame axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from tensordict import TensorDict

from flashdex.errors import LibraryError, nearest
from flashdex.motions.library_check import check_all, check_once, map_arrays
from flashdex.motions.library_format import ARRAYS, read_manifest
from flashdex.motions.library_meshes import Mesh, read_mesh


@dataclass
class MotionLibrary:
    """Reference motions of one collection, never padded over time, never copied.

    ``frames`` (F,), ``motions`` (M,) and ``objects`` (Q,) are memory-mapped; motion
    ``m`` owns the rows ``start[m] ... start[m] + length[m] - 1`` of ``frames``. The
    maps are private: processes share their pages, and no write reaches the files.

    ``quality`` has a row a frame: ``tip_error`` (2, 5), m, robot pad to human tip;
    ``penetration`` (), m, deepest contact of a hand with an object; ``contact`` (2, 5),
    human fingers in contact. It is None where none was measured.

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
    content_hash: str = ""  # of all that the library on disk holds
    _meshes: dict[str, Mesh] = field(default_factory=dict, repr=False)

    @classmethod
    def load(cls, path: str | Path) -> MotionLibrary:
        """Open a directory that ``prepare`` wrote; the first time all of it is checked.

        No file is changed, and none names what is run: see ``docs/security.md``.

        Raises:
            LibraryError: it is missing, of another schema, damaged or changed.
        """
        path = Path(path)
        manifest = read_manifest(path)
        arrays = map_arrays(path, manifest)
        check_once(path, manifest, arrays)
        parts = {part: _as_tensors(arrays, part) for part in _parts(arrays)}
        return cls(
            path=path,
            manifest=manifest.entries,
            content_hash=manifest.sha256,
            **parts,
        )

    def verify(self) -> list[str]:
        """Everything that is wrong with the files, read now, whatever is remembered.

        Empty where nothing is. A changed manifest is told as well.
        """
        try:
            manifest = read_manifest(self.path)
            faults = check_all(self.path, manifest, map_arrays(self.path, manifest))
        except LibraryError as error:
            return [str(error)]
        if manifest.sha256 != self.content_hash:
            faults.insert(0, "manifest.json: is not the one that was opened")
        return faults

    def motion_hash(self, row: int) -> str:
        """SHA-256 of what a motion holds, whatever it is called.

        Of its frames, its rate, hand, roles and supports, and all of its objects.
        """
        return self.manifest["motions"][row]["content_sha256"]

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
        """Convex parts of an object: vertices (V, 3), m, object frame, float32.

        Raises:
            LibraryError: a file is not the one that the library was made with.
        """
        entry = self.manifest["objects"][object_row]
        return [self._mesh(file)[0] for file in entry["parts"]]

    def visual(self, object_row: int) -> trimesh.Trimesh:
        """Visual mesh of an object, m, object frame.

        Raises:
            LibraryError: the file is not the one that the library was made with.
        """
        vertices, faces = self._mesh(self.manifest["objects"][object_row]["visual"])
        return trimesh.Trimesh(vertices, faces, process=False)

    def _mesh(self, file: str) -> Mesh:
        # kept: scenes are built more than once, and a library may be renewed meanwhile
        if file not in self._meshes:
            digest = self.manifest["meshes"][file]
            data = self.manifest["data"]
            self._meshes[file] = read_mesh(self.path, data, file, digest)
        return self._meshes[file]


def _parts(arrays: Mapping[str, np.ndarray]) -> list[str]:
    return list(dict.fromkeys(name.split("/")[0] for name in ARRAYS if name in arrays))


def _as_tensors(arrays: Mapping[str, np.ndarray], part: str) -> TensorDict:
    """One table of the library: the mapped memory itself."""
    tensors = {
        name.removeprefix(f"{part}/"): torch.from_numpy(np.asarray(array))
        for name, array in arrays.items()
        if name.startswith(f"{part}/")
    }
    return TensorDict(tensors, batch_size=[len(next(iter(tensors.values())))])
