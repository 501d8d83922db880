"""Angles of the three wrist hinges (z, x, -y) for a wanted base orientation."""

from __future__ import annotations

import warnings

import numpy as np

from flashdex.datasets.tracks import rotation


def unwrap_wrist(quats: np.ndarray) -> np.ndarray:
    """Hinge angles with R = Rz(a) Rx(b) R-y(c), continuous over time.

    Each orientation has two solutions, (a, b, c) and (a + pi, pi - b, c + pi); the one
    nearer to the previous frame is taken, up to full turns.

    Args:
        quats: wanted orientation of the base, wxyz, (T, 4).

    Returns:
        rad, (T, 3).
    """
    with warnings.catch_warnings():
        # at the singularity scipy warns and picks a valid solution, which is enough
        warnings.simplefilter("ignore", UserWarning)
        first = rotation(quats).as_euler("ZXY") * np.array([1.0, 1.0, -1.0])
    other = np.stack([first[:, 0] + np.pi, np.pi - first[:, 1], first[:, 2] + np.pi], 1)
    out = first.copy()
    for t in range(1, len(quats)):
        options = [_near(o[t], out[t - 1]) for o in (first, other)]
        out[t] = min(options, key=lambda o, t=t: np.abs(o - out[t - 1]).sum())
    middle = (out.min(axis=0) + out.max(axis=0)) / 2
    return out - 2 * np.pi * np.round(middle / (2 * np.pi))


def _near(angles: np.ndarray, previous: np.ndarray) -> np.ndarray:
    return angles - 2 * np.pi * np.round((angles - previous) / (2 * np.pi))
