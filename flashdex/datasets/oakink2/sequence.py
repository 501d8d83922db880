"""One sequence of OakInk2: its files, and the motions that are read from them.

MANO with the flat hand; ``tsl`` is the wrist. A motion is one primitive with the
objects of both hands; without a program it is the whole sequence with all objects, to
be cut by contact. A hand outside of its own interval is present all the same.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import load_mano, rotations_from_quats
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.files import refuse_pointer
from flashdex.datasets.oakink2.annotation import (
    Annotation,
    OakInk2Sequence,
    Primitive,
    read_annotation,
    read_program,
)
from flashdex.datasets.roots import relative
from flashdex.datasets.support import estimate_support
from flashdex.datasets.tracks import transform_pose
from flashdex.errors import DemoError, MeshError
from flashdex.keys import SIDES, Side
from flashdex.objects.meshes import hull_vertices, load_mesh

FPS = 120.0
SUPPORT_STRIDE = 4  # frames; 30 a second are enough to see what rests
Y_UP = Rotation.from_euler("x", np.pi / 2)  # to z up
LICENCE = "OakInk2, see its dataset card (version 1 is CC BY-NC-SA 4.0)"


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
        source="oakink2",
        licence=LICENCE,
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
