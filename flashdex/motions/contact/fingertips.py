"""Fingertips at objects: their distances, and when they touch."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.ndimage import binary_closing, uniform_filter1d

from flashdex.datasets.tracks import rotation, runs
from flashdex.keys import TIP_KEYPOINTS
from flashdex.objects.signed_distance import surface_distance

CONTACT_DISTANCE = 0.015  # m
CLOSE_SECONDS = 0.15
LEAST_SECONDS = 0.10
BLEND_FRAMES = 6
SAMPLE_STEP = 0.003  # m, between the samples that find candidate triangles


def local_tips(keypoints: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Human fingertips in an object's frame, m, (T, 5, 3).

    Args:
        keypoints: m, world, (T, 21, 3).
        pose: of the object, (T, 7).
    """
    tips = keypoints[:, TIP_KEYPOINTS] - pose[:, None, :3]
    return np.einsum("tji,tkj->tki", rotation(pose[:, 3:]).as_matrix(), tips)


def tip_distances(
    keypoints: np.ndarray, pose: np.ndarray, mesh: trimesh.Trimesh
) -> np.ndarray:
    """Unsigned distance of the tips of :func:`local_tips` to a surface, m, (T, 5)."""
    tips = local_tips(keypoints, pose).reshape(-1, 3)
    return surface_distance(mesh, tips, step=SAMPLE_STEP).reshape(-1, 5)


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
    """Weights in 0..1 that ramp over six frames around contact runs, (T, ...)."""
    return uniform_filter1d(mask.astype(float), BLEND_FRAMES, axis=0, mode="nearest")
