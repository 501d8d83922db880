"""Lists OakInk2: both hands and several objects, 120 frames a second, y up.

``anno_preview/<token>.pkl`` holds hands and objects by mocap id,
``program/program_info/<token>.json`` cuts the sequence into primitives,
``object_repair/align_ds/<object id>/`` (or another release of the meshes) holds one
mesh, metres. ``flashdex.datasets.oakink2.sequence`` reads a sequence.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path

from flashdex.datasets.body_models.mano import mano_pair
from flashdex.datasets.files import refuse_clone
from flashdex.datasets.oakink2.annotation import (
    ANNOTATIONS,
    OakInk2Sequence,
    read_program,
)
from flashdex.datasets.oakink2.sequence import read_sequence
from flashdex.datasets.roots import require_folders
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError

# Repaired meshes are more often closed; all releases share the frame of the object.
MESH_FOLDERS = ("object_repair", "object_preview", "object_raw", "object_scan")
ALIGNED = "align_ds"


def list_oakink2(options: SourceOptions) -> list[Recording]:
    """All annotated sequences, in name order."""
    root, mano = options.folder("path"), options.folder("mano")
    require_folders(root, (ANNOTATIONS,), dataset="OakInk2")
    folders = _find_mesh_folders(root, options.models)
    models = mano_pair(mano)
    sequences = [
        OakInk2Sequence(root=root, token=file.stem, mesh_folders=folders, mano=mano)
        for file in sorted((root / ANNOTATIONS).glob("*.pkl"))
    ]
    if sequences:
        refuse_clone([sequences[0].annotation])  # a clone of pointers: all are
    return [
        Recording(
            name=sequence.token,
            read=partial(read_sequence, sequence),
            files=(*_files(sequence), *models),
        )
        for sequence in sequences
    ]


def _find_mesh_folders(root: Path, extra: Path | None) -> tuple[Path, ...]:
    """Folders with a folder for each object; one that the user names goes first."""
    places = [root / release / ALIGNED for release in MESH_FOLDERS]
    places = places if extra is None else [extra / ALIGNED, extra, *places]
    found = tuple(place for place in places if place.is_dir())
    if not found:
        raise DemoError(
            f"{root}: no meshes. Sought "
            f"{', '.join(f'{r}/{ALIGNED}' for r in MESH_FOLDERS)}. Unpack "
            f"object_repair.tar or object_raw.tar there, or name it with --models.",
            code="E_ROOT",
        )
    return found


def _files(sequence: OakInk2Sequence) -> list[Path]:
    """What a sequence depends on; all meshes where its objects are not known yet."""
    files = [sequence.annotation]
    names: set[str] = set()
    if sequence.program.is_file():
        files.append(sequence.program)
        names = _program_objects(sequence.program)
    if not names:
        each = [entry for place in sequence.mesh_folders for entry in place.iterdir()]
        names = {entry.name for entry in each if entry.is_dir()}
    for name in sorted(names):
        with suppress(DemoError):  # reading tells, if the sequence needs it
            files.append(sequence.mesh_file(name))
    return files


def _program_objects(file: Path) -> set[str]:
    """Objects of all primitives; none where a primitive does not name its own."""
    try:
        primitives = read_program(file)
    except DemoError:
        return set()  # reading tells
    known = all(primitive.objects for primitive in primitives)
    return {name for p in primitives for name in p.objects} if known else set()


SOURCE = Source(
    name="oakink2",
    list=list_oakink2,
    about="OakInk2: anno_preview, program and object_repair of bimanual tasks",
    licence="see the dataset card (version 1: CC BY-NC-SA 4.0); MANO under its own",
    needs=("path", "mano"),
)
