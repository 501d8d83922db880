"""Where the files of one OakInk2 sequence lie."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from flashdex.errors import DemoError

ANNOTATIONS, PROGRAMS = "anno_preview", "program/program_info"
MESH_SUFFIXES = (".obj", ".ply")
OBJECT_ID = re.compile(r"\w[\w@.+-]*")  # such as O02@0206@00001


@dataclass(frozen=True, kw_only=True)
class OakInk2Sequence:
    """Where one sequence lies.

    Attributes:
        root: of the dataset.
        token: ``scene_..++...``, the name of its files.
        mesh_folders: that hold a folder for each object, best first.
        mano: folder of the hand model.
    """

    root: Path
    token: str
    mesh_folders: tuple[Path, ...]
    mano: Path

    @property
    def annotation(self) -> Path:
        """Hands and objects."""
        return self.root / ANNOTATIONS / f"{self.token}.pkl"

    @property
    def program(self) -> Path:
        """Primitives; it may be missing."""
        return self.root / PROGRAMS / f"{self.token}.json"

    def mesh_file(self, name: str) -> Path:
        """The one mesh of an object.

        Raises:
            DemoError: no mesh, several, or the id is not a plain name.
        """
        if not OBJECT_ID.fullmatch(name):
            raise DemoError(
                f"{self.token}: E_KEYS: object id {name!r} is not a plain name."
            )
        for folder in (place / name for place in self.mesh_folders):
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            meshes = [file for file in files if file.suffix in MESH_SUFFIXES]
            if len(meshes) > 1:
                raise DemoError(
                    f"{folder}: E_FILE: {len(meshes)} meshes; expected one (.obj or "
                    f".ply). Move the others away."
                )
            if meshes:
                return meshes[0]
        sought = ", ".join(str(place) for place in self.mesh_folders)
        raise DemoError(
            f"{self.token}: E_FILE: no mesh of object {name!r}. Sought in {sought}. "
            f"Download object_repair or object_raw, or name a folder with --models."
        )
