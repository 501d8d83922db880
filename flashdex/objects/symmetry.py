"""Bodies of revolution: their turn about the axis cannot be seen."""

from __future__ import annotations

import numpy as np
import trimesh

from flashdex.objects.signed_distance import surface_distance

EQUAL = 0.10  # relative difference of two moments that may be equal
FAR = 0.03  # of the width: a sample that turns farther off the surface tells
SHARE = 0.99  # of the samples must stay on the surface: a handle is 2 % of a mug
# rad; no regular prism repeats them
ANGLES = 2 * np.pi * (np.arange(10) + 0.5) / 10.618
NUM_SAMPLES = 400
STEPS = 40  # of the samples that find candidate triangles, across the mesh


def revolution_axis(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """The axis of a body of revolution, or None.

    Candidates are the principal axes of the surface whose other two moments are nearly
    equal. Samples are turned about each by ten angles and must stay on the surface,
    within 3 % of the largest distance from the axis.

    Returns:
        Unit vector in the mesh's frame, its largest component positive, (3,); the axis
        passes through the centroid of the surface. Any axis of a sphere.
    """
    centre, moments, axes = _surface_moments(mesh)
    samples, *_ = trimesh.sample.sample_surface(mesh, NUM_SAMPLES, seed=0)
    samples = np.asarray(samples) - centre
    moved = mesh.copy()
    moved.apply_translation(-centre)
    for i in range(3):
        first, second = np.delete(moments, i)
        if abs(first - second) > EQUAL * max(first, second):
            continue
        turns = [trimesh.transformations.rotation_matrix(a, axes[:, i]) for a in ANGLES]
        turned = np.concatenate(
            [samples @ np.asarray(turn)[:3, :3].T for turn in turns]
        )
        step = float(mesh.extents.max()) / STEPS
        gaps = surface_distance(moved, turned, step=step)
        width = np.linalg.norm(np.cross(moved.vertices, axes[:, i]), axis=1).max()
        if np.quantile(gaps, SHARE) < FAR * width:
            return axes[:, i] * np.sign(axes[np.abs(axes[:, i]).argmax(), i])
    return None


def _surface_moments(mesh: trimesh.Trimesh) -> tuple[np.ndarray, ...]:
    """Centroid, and principal moments with their axes (columns), of a surface.

    The integral of x x^T over a triangle of area A and corners v_i is
    ``A / 12 (sum_i v_i v_i^T + s s^T)`` with ``s = sum_i v_i``.
    """
    triangles, area = np.asarray(mesh.triangles), mesh.area_faces
    corners = triangles - mesh.centroid
    total = corners.sum(axis=1)
    inner = np.einsum("f,fci,fcj->ij", area, corners, corners)
    inner += np.einsum("f,fi,fj->ij", area, total, total)
    moments, axes = np.linalg.eigh(inner / (12 * area.sum()))
    return mesh.centroid, moments, axes
