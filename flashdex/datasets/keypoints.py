"""Reads recordings given as hand keypoints and object poses, one .npz a recording.

Keys: ``fps``, ``object`` (the mesh is ``meshes/<object>.obj`` beside the file),
``obj_pose`` (T, 7) (several objects: N names and (T, N, 7)), and per recorded hand
``kp_left`` (T, 21, 3) and, if known, ``palm_left`` (T, 7); right likewise. Metres,
quaternions wxyz, z up. A ``segments*.json`` beside the files (a list of clip, start,
end; end excluded) cuts recordings into motions called ``<clip>_<start>_<end>``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fields import number, numbers, words
from flashdex.datasets.files import load_npz, read_json, told
from flashdex.datasets.roots import listed, on_disk, refuse_odd_name
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.support import demo_support
from flashdex.errors import DemoError, MeshError
from flashdex.keys import SIDES, Side

KEYS = (
    *("fps", "object", "obj_pose"),
    *("kp_left", "kp_right", "palm_left", "palm_right"),
)
REQUIRED = ("fps", "object", "obj_pose")


def list_keypoints(options: SourceOptions) -> list[Recording]:
    """Recordings of a folder or one file, in name order."""
    path = options.folder("path")
    files = [path] if path.is_file() else listed(path, "*.npz")
    if not files:
        raise DemoError(
            f"{path}: no .npz recordings. Expected a folder with <clip>.npz files and "
            f"meshes/<object>.obj, or one such file."
        )
    segments = _read_segments(files[0].parent)
    lists = tuple(listed(files[0].parent, "segments*.json"))
    return [
        Recording(
            name=file.stem,
            read=partial(read_recording, file, segments.get(file.stem)),
            files=(file, *_mesh_files(file), *lists),
        )
        for file in files
    ]


def read_recording(
    file: Path, pieces: list[tuple[int, int]] | None = None
) -> list[HumanDemo]:
    """One recording, cut into pieces (frames from, to) if there are any."""
    demo = read_file(file)
    return [demo] if pieces is None else _cut(demo, pieces)


def read_keypoints(path: str | Path) -> list[HumanDemo]:
    """All motions of a folder or file, read at once."""
    recordings = list_keypoints(SourceOptions(path=Path(path)))
    return [demo for recording in recordings for demo in recording.read()]


def read_file(file: Path) -> HumanDemo:
    """One recording, uncut."""
    data = load_npz(file, only=KEYS, plain=True)
    missing = [key for key in REQUIRED if key not in data]
    hands: list[Side] = [side for side in SIDES if f"kp_{side}" in data]
    if missing or not hands:
        lack = missing + ([] if hands else ["kp_left or kp_right"])
        raise DemoError(f"{file}: lacks {', '.join(lack)}. Found: {', '.join(data)}.")
    keypoints: dict[Side, np.ndarray] = {
        s: numbers(data[f"kp_{s}"], what=f"{file}: kp_{s}") for s in hands
    }
    palm: dict[Side, np.ndarray] = {
        s: numbers(data[f"palm_{s}"], what=f"{file}: palm_{s}")
        for s in hands
        if f"palm_{s}" in data
    }
    licence = file.parent / "LICENSE"
    return HumanDemo(
        name=file.stem,
        fps=number(data["fps"], what=f"{file}: fps"),
        keypoints=keypoints,
        palm=palm,
        objects=_read_objects(file, data),
        source=SOURCE.name,
        licence=str(licence.name) if licence.is_file() else "",
        provenance={"files": [file.name]},
    )


def _read_objects(file: Path, data: dict) -> list[DemoObject]:
    """One object with ``obj_pose`` (T, 7), or several with (T, N, 7)."""
    names = words(data["object"])
    poses = numbers(data["obj_pose"], what=f"{file}: obj_pose")
    if poses.ndim == 2:
        poses = poses[:, None]
    if poses.ndim != 3 or poses.shape[1] != len(names):
        raise DemoError(
            f"{file}: obj_pose has shape {data['obj_pose'].shape}; expected (T, 7), or "
            f"(T, {len(names)}, 7) for the {len(names)} objects {', '.join(names)}."
        )
    return [
        DemoObject(name, _mesh_file(file, name), poses[:, i])
        for i, name in enumerate(names)
    ]


def _mesh_file(file: Path, name: str) -> Path:
    refuse_odd_name(name, what="object", where=file)
    return on_disk(file.parent / "meshes" / f"{name}.obj")


def _mesh_files(file: Path) -> tuple[Path, ...]:
    """Meshes that a recording names; none where it cannot be read (yet)."""
    try:
        names = words(load_npz(file, only=["object"], plain=True)["object"])
        meshes = [_mesh_file(file, name) for name in names]
        return tuple(mesh for mesh in meshes if mesh.is_file())
    except (OSError, KeyError, DemoError):
        return ()


def _read_segments(folder: Path) -> dict[str, list[tuple[int, int]]]:
    pieces: dict[str, list[tuple[int, int]]] = {}
    for file in listed(folder, "segments*.json"):
        fault = "not a list of {clip, start, end}"
        with told(file, fault):
            for row in read_json(file, fault):
                span = (int(row["start"]), int(row["end"]))
                pieces.setdefault(str(row["clip"]), []).append(span)
    return pieces


def _cut(demo: HumanDemo, pieces: list[tuple[int, int]]) -> list[HumanDemo]:
    """Pieces of a recording; they share the table that the whole recording shows."""
    demo.support_z = _support(demo)
    for start, end in pieces:
        if not 0 <= start < end <= demo.num_frames:
            raise DemoError(
                f"{demo.name}: segment {start}-{end} is outside of its "
                f"{demo.num_frames} frames."
            )
    return [demo.cut(a, b, name=f"{demo.name}_{a}_{b}") for a, b in pieces]


def _support(demo: HumanDemo) -> float | None:
    try:
        demo.validate(complete=False)
        return demo_support(demo)
    except (DemoError, MeshError):
        return None  # each piece is judged on its own; some may be sound


SOURCE = Source(
    name="keypoints",
    list=list_keypoints,
    about="a folder of <clip>.npz with keypoints and object poses, or one such file",
)
