"""Human contact: fingertip distances, which hand uses which object, and when."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.ndimage import binary_closing, uniform_filter1d

from flashdex.datasets.tracks import rotation, runs
from flashdex.keys import TIP_KEYPOINTS
from flashdex.objects.signed_distance import surface_distance

CONTACT_DISTANCE = 0.015  # m
NO_OBJECT = 10.0  # m, tip distance of a hand without object
CLOSE_SECONDS = 0.15
LEAST_SECONDS = 0.10
BLEND_FRAMES = 6
SAMPLE_STEP = 0.003  # m, between the samples that find candidate triangles


def tip_distances(
    keypoints: np.ndarray, pose: np.ndarray, mesh: trimesh.Trimesh
) -> np.ndarray:
    """Unsigned distance of the human fingertips to an object's surface.

    Args:
        keypoints: m, world, (T, 21, 3).
        pose: of the object, (T, 7).
        mesh: of the object, m.

    Returns:
        m, (T, 5).
    """
    tips = keypoints[:, TIP_KEYPOINTS] - pose[:, None, :3]
    local = np.einsum("tji,tkj->tki", rotation(pose[:, 3:]).as_matrix(), tips)
    gaps = surface_distance(mesh, local.reshape(-1, 3), step=SAMPLE_STEP)
    return gaps.reshape(local.shape[:2])


def assign_object(distances: list[np.ndarray]) -> int:
    """Slot of the object that a hand touches longest; the nearest one breaks ties.

    Args:
        distances: per object (T, 5), m.
    """
    nearest = [d.min(axis=1) for d in distances]
    scores = [(int((n < CONTACT_DISTANCE).sum()), -float(n.min())) for n in nearest]
    return max(range(len(scores)), key=scores.__getitem__)


def contact_runs(distances: np.ndarray, fps: float) -> np.ndarray:
    """Fingers in contact, (T, 5): below 15 mm, gaps closed, short touches dropped."""
    mask = distances < CONTACT_DISTANCE
    size = max(int(CLOSE_SECONDS * fps), 1)
    out = np.zeros_like(mask)
    for finger in range(mask.shape[1]):
        padded = np.pad(mask[:, finger], size, mode="edge")
        closed = binary_closing(padded, np.ones(size))[size:-size]
        for start, end in runs(closed, least=max(int(LEAST_SECONDS * fps), 2)):
            out[start:end, finger] = True
    return out


def blend(mask: np.ndarray) -> np.ndarray:
    """Weights in 0..1 that ramp over six frames around contact runs, (T, 5)."""
    return uniform_filter1d(mask.astype(float), BLEND_FRAMES, axis=0, mode="nearest")
