"""Lists TACO: a tool, a target and both hands, 30 frames a second, z up.

``Hand_Poses/(verb, tool, target)/<sequence>/`` holds ``<side>_hand.pkl`` (older: a
folder ``<side>_hand`` of one file a frame) and ``<side>_hand_shape.pkl``;
``Object_Poses/(verb, tool, target)/<sequence>/`` holds ``tool_<id>.npy`` and
``target_<id>.npy``, (T, 4, 4), m; ``Object_Models/<id>_cm.obj`` are the meshes.
``flashdex.datasets.taco.sequence`` reads a sequence.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

from flashdex.datasets.body_models.mano import mano_pair
from flashdex.datasets.files import refuse_clone, told
from flashdex.datasets.roots import require_folders
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.taco.sequence import (
    HANDS,
    OBJECTS,
    ROLES,
    TacoSequence,
    mesh_id,
    read_sequence,
)
from flashdex.errors import DemoError

MESH_FOLDERS = (
    "Object_Models",
    "Object_Models/object_models_released",
    "object_models_released",
)
MESH_SUFFIX = "_cm.obj"
TRIPLET = re.compile(r"\([^,]+, [^,]+, [^)]+\)")
SPLIT_LINE = re.compile(r"(\d{8}_\d+),(\w+)")
SPLIT_LIST = "v1_overall_data_train_test_split.txt"

logger = logging.getLogger(__name__)


def list_taco(options: SourceOptions) -> list[Recording]:
    """All sequences that have hands or objects, in name order."""
    root, mano = options.folder("path"), options.folder("mano")
    require_folders(root, (HANDS, OBJECTS), dataset="TACO")
    meshes = _find_meshes(root, options.models)
    models = mano_pair(mano)
    folders = sorted({*_folders(root / HANDS), *_folders(root / OBJECTS)})
    splits = _read_splits(options.splits, folders) if options.splits else {}
    recordings = []
    for folder, name in zip(folders, _unique_names(folders), strict=True):
        split = splits.get(Path(folder).name, "")
        whole = TacoSequence(
            root=root, folder=folder, name=name, split=split, meshes=meshes, mano=mano
        )
        recordings.append(_recording(whole, models))
    # an unfetched repository consists of pointers only
    refuse_clone(recordings[0].files if recordings else ())
    return recordings


def _recording(whole: TacoSequence, models: tuple[Path, ...]) -> Recording:
    ids = [mesh_id(file) for role in ROLES for file in whole.pose_files(role)]
    # only the meshes it uses: a recording goes to another process
    used = {key: whole.meshes[key] for key in ids if key in whole.meshes}
    sequence = replace(whole, meshes=used)
    return Recording(
        name=sequence.name,
        read=partial(read_sequence, sequence),
        files=(*sequence.files(), *models),
        key=f"{sequence.folder} {sequence.split}",
    )


def _find_meshes(root: Path, extra: Path | None) -> dict[str, Path]:
    """File of each mesh id; a folder that the user names goes first."""
    places = [root / folder for folder in MESH_FOLDERS]
    places = places if extra is None else [extra, *places]
    found: dict[str, Path] = {}
    for place in places:
        for file in sorted(place.glob(f"*{MESH_SUFFIX}")):
            found.setdefault(file.name.removesuffix(MESH_SUFFIX), file)
    if not found:
        sought = ", ".join(str(place) for place in places)
        raise DemoError(
            f"{root}: no meshes <id>{MESH_SUFFIX}. Sought in {sought}. "
            f"Download Object_Models, or name its folder with --models.",
            code="E_ROOT",
        )
    return found


def _folders(root: Path) -> list[str]:
    """``(verb, tool, target)/<sequence>`` of all sequences below a folder."""
    found = []
    for triplet in sorted(entry for entry in root.iterdir() if entry.is_dir()):
        if not TRIPLET.fullmatch(triplet.name):
            logger.warning("%s: not '(verb, tool, target)'; left out", triplet)
            continue
        found += [
            f"{triplet.name}/{entry.name}"
            for entry in triplet.iterdir()
            if entry.is_dir() and not entry.name.startswith(".")
        ]
    return found


def _unique_names(folders: list[str]) -> list[str]:
    """Names of the sequences; the triplet is added where two share a name."""
    counts = Counter(Path(folder).name for folder in folders)
    names = []
    for folder in folders:
        triplet, sequence = folder.split("/")
        words = re.sub(r"[^\w-]+", "_", triplet).strip("_")
        names.append(sequence if counts[sequence] == 1 else f"{sequence}_{words}")
    return names


def _read_splits(file: Path, folders: list[str]) -> dict[str, str]:
    """Split of each sequence, from lines ``sequence,split``."""
    with told(file, "not a readable list of splits"):
        lines = file.read_text(encoding="utf-8").split()
    matches = [SPLIT_LINE.fullmatch(line) for line in lines]
    splits = {match[1]: match[2] for match in matches if match}
    known = {Path(folder).name for folder in folders}
    if None in matches or not known & set(splits):
        fault = lines[matches.index(None)] if None in matches else "no sequence in use"
        raise DemoError(
            f"{file}: expected lines 'sequence,split' as in TACO's {SPLIT_LIST}, like "
            f"'20231104_017,train'; found {fault!r}."
        )
    return splits


SOURCE = Source(
    name="taco",
    list=list_taco,
    about="TACO: Hand_Poses, Object_Poses and Object_Models of bimanual tool use",
    licence="CC BY 4.0; MANO under its own licence (non-commercial research)",
    needs=("path", "mano"),
)
