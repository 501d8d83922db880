"""Finds the mesh of an object by its id in folders of meshes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import trimesh

from flashdex.errors import DemoError, MeshError
from flashdex.objects.meshes import load_mesh

SUFFIXES = (".obj", ".ply", ".stl", ".glb")
# names that exporters give the one mesh to look at in an object's own folder
FAVOURITES = ("visual", "mesh")


def seek_mesh(name: str, folders: Iterable[Path]) -> Path | None:
    """Mesh file of an object, or None.

    In each folder in turn: ``<name>.{obj,ply,stl,glb}``, then ``<name>/visual.obj``,
    ``<name>/mesh.obj``, ``<name>/<name>.obj`` (or another suffix), then the only mesh
    in ``<name>/``.

    Args:
        name: id of the object; a plain name, not a path.
        folders: where to look, in order.

    Raises:
        DemoError: the id is a path, or its folder holds several meshes and none of the
            names above.
    """
    if not name or name in (".", "..") or name != Path(name).name or "\\" in name:
        raise DemoError(f"Object id '{name}' must be a plain name, not a path.")
    for folder in folders:
        for suffix in SUFFIXES:
            if (file := folder / f"{name}{suffix}").is_file():
                return file
        if (found := mesh_in(folder / name)) is not None:
            return found
    return None


def find_mesh(name: str, folders: Iterable[Path], *, where: Path | str) -> Path:
    """As ``seek_mesh``, but a missing mesh is an error.

    Args:
        name: id of the object.
        folders: where to look, in order.
        where: the recording, for the message.

    Raises:
        DemoError: names the folders that were searched.
    """
    folders = list(folders)
    found = seek_mesh(name, folders)
    if found is None:
        places = ", ".join(map(str, folders))
        raise DemoError(
            f"{where}: no mesh of object '{name}'. Sought {name}.obj (.ply, .stl, "
            f".glb) and {name}/*.obj in: {places}. Give the folder of the meshes with "
            f"--models."
        )
    return found


def mesh_in(folder: Path) -> Path | None:
    """The mesh in an object's own folder, or None if it has none.

    Raises:
        DemoError: several meshes, none with a name that tells which to take.
    """
    if not folder.is_dir():
        return None
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES)
    for stem in (*FAVOURITES, folder.name):
        for file in files:
            if file.stem == stem:
                return file
    if len(files) > 1:
        names = ", ".join(f.name for f in files[:4])
        raise DemoError(
            f"{folder}: {len(files)} meshes ({names}, ...). Expected one, or one "
            f"called visual.obj."
        )
    return files[0] if files else None


def scaled_mesh(file: Path, scale: float) -> Path | trimesh.Trimesh:
    """The mesh file itself, or its mesh made larger by ``scale``.

    Raises:
        DemoError: the mesh has to be scaled and cannot be read.
    """
    if scale == 1.0:
        return file
    try:
        return load_mesh(file).apply_scale(scale)
    except MeshError as error:
        raise DemoError(str(error)) from error
