"""Reads imported clips of FlashDexRetarget: ``human_demo/<clip>.npz``, ``motion.pt``.

A clip holds per hand (s = left, right) ``mano_{s}_joints`` (T, 20, 3), named
``<finger>_<level>`` and sorted by name, ``mano_{s}_wrist_pos`` (T, 3) and ``..._rot``
(T, 3, 3), ``obj_{s}_pose`` (T, 4, 4) and ``obj_{s}_id``, whose mesh is
``objects/<id>/visual.obj``, to be scaled by ``obj_{s}_scale``. Metres, z up. A packed
``motion.pt`` is read where a folder has no clips (``fdr.pack``).
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.fdr.clip import LICENCE, make_demo
from flashdex.datasets.fdr.pack import NAME as PACK_NAME
from flashdex.datasets.fdr.pack import pack_names, pack_objects, unpack
from flashdex.datasets.fields import require, words
from flashdex.datasets.files import load_npz, refuse_clone
from flashdex.datasets.roots import listed, seek_mesh, shown
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError
from flashdex.keys import SIDES

CLIP_FOLDERS = ("human_demo", "retargeted")


def list_fdr(options: SourceOptions) -> list[Recording]:
    """Clips of a dataset folder, a folder of clips, one clip, or a ``motion.pt``."""
    clips, pack = _find(options.folder("path"))
    refuse_clone([pack] if pack else clips[:1])
    if pack is not None:
        folders = mesh_folders(pack.parent, options.models)
        meshes = _existing(pack_objects(pack), folders)
        return [
            Recording(
                name=name,
                read=partial(read_packed, pack, row, folders),
                files=(pack, *meshes),
                key=name,
            )
            for row, name in enumerate(pack_names(pack))
        ]
    folders = mesh_folders(clips[0].parent, options.models)
    return [
        Recording(
            name=clip.stem,
            read=partial(read_clip, clip, folders),
            files=(clip, *_existing(_ids(clip), folders)),
        )
        for clip in clips
    ]


def mesh_folders(folder: Path, objects: Path | None) -> tuple[Path, ...]:
    """Where meshes may lie: ``--models``, then beside and above the clips."""
    roots = (folder, folder.parent) if folder.name in CLIP_FOLDERS else (folder,)
    near = [root / name for root in roots for name in ("objects", "meshes")]
    return (*([objects] if objects else []), *near)


def read_clip(file: Path, folders: tuple[Path, ...]) -> list[HumanDemo]:
    """One clip as one motion."""
    clip = load_npz(file)
    require(clip, "fps", where=str(file))
    demo = make_demo(clip, file, file.stem, folders)
    demo.provenance |= {"files": [file.name]}
    return [demo]


def read_packed(file: Path, row: int, folders: tuple[Path, ...]) -> list[HumanDemo]:
    """One clip of a ``motion.pt`` as one motion."""
    clip, notes = unpack(file, row)
    demo = make_demo(clip, file, pack_names(file)[row], folders)
    demo.provenance |= {"files": [file.name], "row": row} | notes
    return [demo]


def _find(path: Path) -> tuple[list[Path], Path | None]:
    if path.is_file():
        return ([path], None) if path.suffix.lower() == ".npz" else ([], path)
    for folder in (path / CLIP_FOLDERS[0], path, path / CLIP_FOLDERS[1]):
        # ``.tmp.npz``: FDR was stopped while it wrote a clip
        clips = [c for c in listed(folder, "*.npz") if not c.match("*.tmp.npz")]
        if clips:
            return clips, None
    if (path / PACK_NAME).is_file():
        return [], path / PACK_NAME
    raise DemoError(
        f"{path}: no clips of FlashDexRetarget. Sought human_demo/*.npz, "
        f"*.npz, retargeted/*.npz and motion.pt; found: "
        f"{shown(path)}. Give the folder that its import writes.",
        code="E_ROOT",
    )


def _ids(clip: Path) -> list[str]:
    """Objects that a clip names; none where it cannot be read (reading tells why)."""
    names = [f"obj_{side}_id" for side in SIDES] + ["desk_context_ids"]
    try:
        arrays = load_npz(clip, only=names).values()
    except DemoError:
        return []
    return sorted({name for array in arrays for name in words(array)})


def _existing(names: list[str], folders: tuple[Path, ...]) -> tuple[Path, ...]:
    """Meshes that exist; reading tells which one is missing or wrong."""
    found: list[Path | None] = []
    for name in names:
        with suppress(DemoError, OSError):
            found.append(seek_mesh(name, folders))
    return tuple(file for file in found if file is not None)


SOURCE = Source(
    name="fdr",
    list=list_fdr,
    about="clips of FlashDexRetarget: human_demo/<clip>.npz, or its motion.pt",
    licence=LICENCE,
)
