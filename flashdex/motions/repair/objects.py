"""Objects of a recording, before anything is measured: their meshes and frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.errors import MeshError
from flashdex.motions.contact.activity import has_moved
from flashdex.motions.findings import Finding, warn
from flashdex.motions.repair.repair import keep

FAR = 0.1  # m, of a mesh from the origin of its frame


def settle_objects(demo: HumanDemo) -> tuple[HumanDemo, list[Finding]]:
    """A recording with its meshes read, and each frame within its mesh.

    An object that never moves and whose mesh cannot be read is left out: nothing is
    lost with it. One that moves, that the recording says a hand uses, or that is the
    only one, stays, and is refused where its mesh is needed.

    A mesh far from the origin of its frame is moved there, and its pose with it:
    positions are measured at that origin, where a turn of a degree would otherwise
    count as centimetres. The provenance names the shift, m, in ``mesh_shift``.

    Returns:
        The recording, and findings about its objects.
    """
    if set(demo.palm) < set(demo.keypoints) or any(
        body.pose.shape[1:] != (7,) for body in demo.objects
    ):
        return demo, []  # of a wrong shape, which validation tells
    used = set(demo.hand_object.values())
    bodies, shifts, kept, found = list(demo.objects), {}, [], []
    for place, body in enumerate(demo.objects):
        is_needed = place in used or len(demo.objects) == 1 or has_moved(body.pose)
        try:
            bodies[place], shift = _settled(body)
        except MeshError as error:
            if is_needed:
                kept.append(place)
                continue
            text = f"object '{body.name}', which never moves, left out: {error.text}"
            found.append(warn("E_MESH", text))
            continue
        kept.append(place)
        if shift is not None:
            shifts[body.name] = shift.round(6).tolist()
            text = f"the mesh of '{body.name}' lies {np.linalg.norm(shift):.2f} m from "
            text += "the origin of its frame; both were moved, so that errors are "
            found.append(warn("W_ORIGIN", f"{text}measured at its centre"))
    if not kept:
        return demo, []
    told = demo.provenance | ({"mesh_shift": shifts} if shifts else {})
    demo = replace(demo, objects=bodies, provenance=told)
    return keep(demo, list(demo.keypoints), kept), found


def _settled(body: DemoObject) -> tuple[DemoObject, np.ndarray | None]:
    """An object with its mesh, near its frame; and by what both were moved, m, (3,)."""
    mesh = body.load_mesh()
    shift = _far_centre(mesh)
    if shift is None:
        return replace(body, mesh=mesh), None
    pose = body.pose.copy()
    seen = ~missing_frames(pose)
    if seen.any():
        pose[seen, :3] += rotation(pose[seen, 3:]).apply(shift)
    mesh = trimesh.Trimesh(mesh.vertices - shift, mesh.faces, process=False)
    return replace(body, mesh=mesh, pose=pose), shift


def _far_centre(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Middle of a mesh whose frame begins outside of it, m, (3,); else None."""
    if not len(mesh.faces) or not np.isfinite(mesh.bounds).all():
        return None
    low, high = mesh.bounds
    away = np.linalg.norm(np.maximum(low, 0) + np.minimum(high, 0))
    return (low + high) / 2 if away > FAR else None
