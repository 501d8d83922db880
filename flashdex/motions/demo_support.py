"""Table of a whole recording, before it is cut: its pieces share it."""

from __future__ import annotations

import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import missing_frames, runs, transform_pose
from flashdex.motions.align import UP_ROTATION
from flashdex.motions.support import estimate_support
from flashdex.objects.meshes import clean_mesh, hull_vertices


def demo_support(
    demo: HumanDemo, meshes: list[trimesh.Trimesh] | None = None
) -> float | None:
    """Height of the table that a recording's objects rest on; None if none rests.

    Args:
        demo: with NaN where an object was not tracked.
        meshes: of its objects, cleaned, m; read by default.

    Returns:
        m, along the recording's up axis.

    Raises:
        MeshError: a mesh cannot be used.
    """
    if meshes is None:
        meshes = [clean_mesh(b.load_mesh(), name=b.name) for b in demo.objects]
    turn = Rotation.from_euler("x", UP_ROTATION[demo.up])
    poses, vertices = [], []
    for body, mesh in zip(demo.objects, meshes, strict=True):
        hull = hull_vertices(mesh)
        for start, end in runs(~missing_frames(body.pose), least=3):
            poses.append(transform_pose(body.pose[start:end], turn))
            vertices.append(hull)
    if not poses:
        return None
    height, found = estimate_support(poses, vertices, demo.fps)
    return height if found else None
