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
    used, found, kept = set(demo.hand_object.values()), [], []
    bodies, shifts = list(demo.objects), {}
    for place, body in enumerate(demo.objects):
        try:
            mesh = body.load_mesh()
        except MeshError as error:
            if place in used or has_moved(body.pose) or len(demo.objects) == 1:
                kept.append(place)
                continue
            text = f"object '{body.name}', which never moves, left out: {error.text}"
            found.append(warn("E_MESH", text))
            continue
        kept.append(place)
        bodies[place] = replace(body, mesh=mesh)
        if (shift := _far_centre(mesh)) is not None:
            bodies[place] = _shifted(bodies[place], mesh, shift)
            shifts[body.name] = shift.round(6).tolist()
            away = float(np.linalg.norm(shift))
            text = f"the mesh of '{body.name}' lies {away:.2f} m from the origin of its"
            text += " frame; both were moved, so that errors are measured at its centre"
            found.append(warn("W_ORIGIN", text))
    if not kept:
        return demo, []
    told = demo.provenance | ({"mesh_shift": shifts} if shifts else {})
    demo = replace(demo, objects=bodies, provenance=told)
    return keep(demo, list(demo.keypoints), kept), found


def _far_centre(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Middle of a mesh whose frame begins outside of it, m, (3,); else None."""
    if not len(mesh.faces) or not np.isfinite(mesh.bounds).all():
        return None
    low, high = mesh.bounds
    away = np.linalg.norm(np.maximum(low, 0) + np.minimum(high, 0))
    return (low + high) / 2 if away > FAR else None


def _shifted(body: DemoObject, mesh: trimesh.Trimesh, shift: np.ndarray) -> DemoObject:
    pose = body.pose.copy()
    seen = ~missing_frames(pose)
    if seen.any():
        pose[seen, :3] += rotation(pose[seen, 3:]).apply(shift)
    mesh = trimesh.Trimesh(mesh.vertices - shift, mesh.faces, process=False)
    return replace(body, mesh=mesh, pose=pose)
