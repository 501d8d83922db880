"""Reads OakInk2: both hands and several objects, 120 frames a second, y up.

``anno_preview/<token>.pkl`` holds hands and objects by mocap id,
``program/program_info/<token>.json`` cuts the sequence into primitives,
``object_repair/align_ds/<object id>/`` (or another release of the meshes) holds one
mesh, metres.

MANO with the flat hand; ``tsl`` is the wrist. A motion is one primitive with the
objects of both hands; without a program it is the whole sequence with all objects, to
be cut by contact. A hand outside of its own interval is present all the same.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import (
    load_mano,
    mano_pair,
    rotations_from_quats,
)
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.files import refuse_clone, refuse_pointer
from flashdex.datasets.oakink2.annotation import (
    ANNOTATIONS,
    Annotation,
    OakInk2Sequence,
    Primitive,
    read_annotation,
    read_program,
)
from flashdex.datasets.roots import listed, relative, require_folders
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.support import estimate_support
from flashdex.datasets.tracks import transform_pose
from flashdex.errors import DemoError, MeshError
from flashdex.keys import SIDES, Side
from flashdex.objects.meshes import hull_vertices, load_mesh

FPS = 120.0
SUPPORT_STRIDE = 4  # frames; 30 a second are enough to see what rests
Y_UP = Rotation.from_euler("x", np.pi / 2)  # to z up


def read_sequence(sequence: OakInk2Sequence) -> list[HumanDemo]:
    """All primitives of a sequence as motions, or the whole sequence as one."""
    refuse_pointer(sequence.annotation)
    annotation = read_annotation(sequence.annotation)
    primitives = [None]
    if sequence.program.is_file():
        primitives = read_program(sequence.program)
    meshes: dict[str, trimesh.Trimesh] = {}
    demos = [_demo(sequence, annotation, item, meshes) for item in primitives]
    seen: dict[str, int] = {}
    for demo in demos:  # two primitives may share their range
        count = seen[demo.name] = seen.get(demo.name, 0) + 1
        demo.name += f"_{count}" if count > 1 else ""
    return demos


def _demo(
    sequence: OakInk2Sequence,
    annotation: Annotation,
    item: Primitive | None,
    meshes: dict[str, trimesh.Trimesh],
) -> HumanDemo:
    begin, end = annotation.first, annotation.first + annotation.num_frames
    name = sequence.token
    if item is not None:
        _refuse_outside(sequence, item, begin, end)
        begin, end = item.begin, item.end
        name = f"{name}_{begin}_{end}"
    frames = slice(begin - annotation.first, end - annotation.first)
    ids = (item.objects if item else []) or list(annotation.poses)
    bodies = [_body(sequence, annotation, body, meshes) for body in ids]
    support, notes = _support(bodies)
    files = [sequence.annotation, *map(sequence.mesh_file, ids)]
    files += [] if item is None else [sequence.program]
    keypoints: dict[Side, np.ndarray] = {
        side: _keypoints(sequence, annotation, side, frames) for side in SIDES
    }
    demo = HumanDemo(
        name=name,
        fps=FPS,
        keypoints=keypoints,
        objects=[DemoObject(b.name, b.mesh, b.pose[frames]) for b in bodies],
        source=SOURCE.name,
        licence="OakInk2, see its dataset card (version 1 is CC BY-NC-SA 4.0)",
        up="y",
        support_z=support,
        needs_cutting=item is None,
        provenance={
            "files": [relative(file, sequence.root) for file in files],
            "fps": FPS,
            "frames": [begin, end],
            "objects": ids,
            "notes": [*annotation.notes, *notes],
        },
    )
    if item is not None:
        _tell_primitive(demo, item, ids)
    return demo


def _tell_primitive(demo: HumanDemo, item: Primitive, ids: list[str]) -> None:
    """What the program says of a motion; a hand with one object uses that one."""
    demo.task = item.name
    demo.hand_object = {
        side: ids.index(own[0])
        for side, own in item.hand_objects.items()
        if len(own) == 1
    }
    demo.provenance |= {
        "interaction_mode": item.mode,
        "intervals": {side: list(pair) for side, pair in item.intervals.items()},
    }


def _refuse_outside(
    sequence: OakInk2Sequence, item: Primitive, begin: int, end: int
) -> None:
    if item.begin < begin or item.end > end:
        raise DemoError(
            f"{sequence.program}: primitive '{item.name}' has the mocap ids "
            f"{item.begin} to {item.end}, the annotation {begin} to {end} (end "
            f"excluded). Program and annotation are not of the same release.",
            code="E_LEN",
        )


def _body(
    sequence: OakInk2Sequence,
    annotation: Annotation,
    name: str,
    meshes: dict[str, trimesh.Trimesh],
) -> DemoObject:
    """An object over the whole sequence, under a name that is a plain file name."""
    if name not in annotation.poses:
        raise DemoError(
            f"{sequence.program}: object {name!r} is not in "
            f"{sequence.annotation.name}; there are {', '.join(annotation.poses)}.",
            code="E_KEYS",
        )
    if name not in meshes:
        file = sequence.mesh_file(name)
        refuse_pointer(file)
        meshes[name] = _load_mesh(file)
    return DemoObject(name.replace("@", "-"), meshes[name], annotation.poses[name])


def _load_mesh(file: Path) -> trimesh.Trimesh:
    try:
        mesh = load_mesh(file)
        _ = mesh.convex_hull  # kept by the mesh
    except MeshError as error:
        raise DemoError(error.text, code="E_MESH") from error
    except (QhullError, ValueError, IndexError) as error:
        raise DemoError(f"{file}: flat, empty or not finite.", code="E_MESH") from error
    return mesh


def _support(bodies: list[DemoObject]) -> tuple[float, list[str]]:
    """Height of the table under these objects, from the whole sequence.

    A primitive alone often shows nothing at rest. The origin lies about on the table,
    so 0 where nothing ever rests.
    """
    poses, vertices = [], []
    for body in bodies:
        pose = body.pose[::SUPPORT_STRIDE]
        pose = pose[np.isfinite(pose).all(axis=1)]
        if len(pose) >= 2:
            poses.append(transform_pose(pose, Y_UP))
            vertices.append(hull_vertices(body.load_mesh()))
    height, found = 0.0, False
    if poses:
        height, found = estimate_support(poses, vertices, FPS / SUPPORT_STRIDE)
    if found:
        return height, []
    return 0.0, ["W_SUPPORT: nothing rests; the table is taken to be at y = 0"]


def _keypoints(
    sequence: OakInk2Sequence, annotation: Annotation, side: Side, frames: slice
) -> np.ndarray:
    """Keypoints, m, (T, 21, 3); NaN where the hand was not tracked."""
    track = annotation.hands[side]
    betas = np.nanmedian(track.betas, axis=0)  # constant but for damaged frames
    return load_mano(sequence.mano, side).keypoints(
        rotations_from_quats(track.quats[frames]),
        betas,
        track.wrist[frames],
        convention="wrist",
    )


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
        for file in listed(root / ANNOTATIONS, "*.pkl")
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
        each = [
            entry for place in sequence.mesh_folders for entry in listed(place, "*")
        ]
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
