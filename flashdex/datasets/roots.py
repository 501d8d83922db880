"""Is this folder the root of a dataset? What a wrong root looks like, in words."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import trimesh

from flashdex.errors import DemoError, FlashdexError, MeshError
from flashdex.objects.meshes import load_mesh
from flashdex.system.names import check_name

ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".7z")
MAX_LEVELS = 32  # of folders below a root
NUM_SHOWN = 8  # entries of a folder that a message shows
SUFFIXES = (".obj", ".ply", ".stl", ".glb")
FAVOURITES = ("visual", "mesh")  # what exporters call the one mesh to look at


def require_folders(root: Path, folders: Sequence[str], *, dataset: str) -> None:
    """Refuse a root that lacks the folders of a dataset; tell what is meant."""
    missing = [folder for folder in folders if not (root / folder).is_dir()]
    if missing:
        raise DemoError(
            f"{root}: not the root of {dataset}. Sought the folders "
            f"{', '.join(folders)}; missing: {', '.join(missing)}; "
            f"found: {shown(root)}.{_hint(root, folders)}",
            code="E_ROOT",
        )


def listed(folder: Path, pattern: str) -> list[Path]:
    """Entries below a folder, by a pattern such as ``s*/*.npz``; sorted by path.

    As folders are found on disks: links are followed, case does not matter, and what is
    hidden (twins ``._x`` of macOS, what is half downloaded) is left out. Nothing where
    there is no such folder.
    """
    head, _, rest = pattern.partition("/")
    if not folder.is_dir():
        return []
    found = [
        folder / entry.name
        for entry in os.scandir(folder)
        if not entry.name.startswith(".")
        and fnmatchcase(entry.name.casefold(), head.casefold())
    ]
    if rest:
        found = [below for entry in found for below in listed(entry, rest)]
    return sorted(found)


def listed_below(folder: Path, name: str) -> list[Path]:
    """Files of a name in a folder and everywhere below it, as ``listed``.

    Raises:
        DemoError: links lead round in a circle, or far too deep.
    """
    found, level, seen = [], [folder], set()
    for _ in range(MAX_LEVELS):
        deeper = []
        for place in level:
            real = os.path.realpath(place)
            if real in seen:
                continue
            seen.add(real)
            found += [f for f in listed(place, name) if not f.is_dir()]
            deeper += [entry for entry in listed(place, "*") if entry.is_dir()]
        level = deeper
    if level:
        text = f"{folder}: more than {MAX_LEVELS} levels of folders. Give the root."
        raise DemoError(text, code="E_ROOT")
    return sorted(found)


def on_disk(file: Path) -> Path:
    """A file as the disk calls it, where case or the form of its accents differs."""
    if file.exists():
        return file
    name = _alike(file.name)
    same = [f for f in listed(file.parent, "*") if _alike(f.name) == name]
    return same[0] if len(same) == 1 else file


def _alike(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def relative(file: Path, root: Path) -> str:
    """The path inside the root, for provenance; the bare name of a file elsewhere."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def shown(root: Path) -> str:
    """What stands at a path, for a message: the first names of a folder."""
    if not root.exists():
        return "no such path"
    if not root.is_dir():
        return "a file"
    names = sorted(entry.name for entry in root.iterdir())
    more = f" and {len(names) - NUM_SHOWN} more" if len(names) > NUM_SHOWN else ""
    return (", ".join(names[:NUM_SHOWN]) or "an empty folder") + more


def _hint(root: Path, folders: Sequence[str]) -> str:
    if root.suffix in ARCHIVES and root.is_file():
        return " Unpack the archive and give the folder."
    if not root.is_dir():
        return ""
    above = root.resolve().parents[:3]
    inside = [entry for entry in listed(root, "*") if entry.is_dir()]
    for place, where in [(above, "inside"), (inside, "above")]:
        for folder in place:
            if all((folder / name).is_dir() for name in folders):
                return f" It lies {where} the root: give {folder}."
    packed = [e.name for e in sorted(root.iterdir()) if e.suffix in ARCHIVES]
    return f" Unpack {', '.join(packed[:NUM_SHOWN])}." if packed else ""


def refuse_odd_name(name: str, *, what: str, where: Path | str = "") -> None:
    """A ``DemoError`` where a name out of a file is none, see ``check_name``."""
    try:
        check_name(name, what=what, where=str(where))
    except FlashdexError as error:
        raise DemoError(error.text, code="E_KEYS") from error


def seek_mesh(name: str, folders: Iterable[Path]) -> Path | None:
    """Mesh file of an object, or None.

    In each folder in turn: ``<name>.{obj,ply,stl,glb}``, then ``<name>/visual.obj``,
    ``<name>/mesh.obj``, ``<name>/<name>.obj`` (or another suffix), then the only mesh
    in ``<name>/``. A ``DemoError`` where the id is a path, or several meshes stand in
    its folder and none of these names.
    """
    refuse_odd_name(name, what="object")
    for folder in folders:
        for suffix in SUFFIXES:
            if (file := on_disk(folder / f"{name}{suffix}")).is_file():
                return file
        if (found := mesh_in(folder / name)) is not None:
            return found
    return None


def find_mesh(name: str, folders: Iterable[Path], *, where: Path | str) -> Path:
    """As ``seek_mesh``; where there is none, a ``DemoError`` names the folders."""
    folders = list(folders)
    found = seek_mesh(name, folders)
    if found is None:
        places = ", ".join(map(str, folders))
        raise DemoError(
            f"{where}: no mesh of object '{name}'. Sought {name}.obj (.ply, .stl, "
            f".glb) and {name}/*.obj in: {places}. Give the folder of the meshes with "
            f"--models.",
            code="E_FILE",
        )
    return found


def mesh_in(folder: Path) -> Path | None:
    """The mesh in an object's own folder, or None; several need a telling name."""
    if not folder.is_dir():
        return None
    files = [f for f in listed(folder, "*") if f.suffix.lower() in SUFFIXES]
    for stem in (*FAVOURITES, folder.name):
        for file in files:
            if file.stem.casefold() == stem.casefold():
                return file
    if len(files) > 1:
        names = ", ".join(f.name for f in files[:4])
        raise DemoError(
            f"{folder}: {len(files)} meshes ({names}, ...). Expected one, or one "
            f"called visual.obj.",
            code="E_FILE",
        )
    return files[0] if files else None


def require_mesh(file: Path, hint: str) -> Path:
    """Refuse a mesh that is missing; the hint says what to do, with --models."""
    file = on_disk(file)
    if not file.is_file():
        raise DemoError(f"{file}: mesh not found. {hint} with --models.", code="E_FILE")
    return file


def scaled_mesh(file: Path, scale: float) -> Path | trimesh.Trimesh:
    """The mesh file itself, or its mesh made larger by ``scale``."""
    if scale == 1.0:
        return file
    try:
        return load_mesh(file).apply_scale(scale)
    except MeshError as error:
        raise DemoError(error.text, code="E_MESH") from error
