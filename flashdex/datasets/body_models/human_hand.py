"""A parametric human hand: 21 keypoints from joint angles, and a grasp fitted to it.

Right hand in its palm frame: x along the middle metacarpal, z out of the palm, y to the
little finger. The left hand is its mirror image in the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

# knuckles (MCP) of index, middle, ring and pinky, m, palm frame
KNUCKLES = np.array(
    [
        [0.094, -0.022, 0.0],
        [0.096, 0.0, 0.0],
        [0.091, 0.020, 0.0],
        [0.084, 0.038, 0.0],
    ]
)
PHALANGES = np.array(
    [
        [0.044, 0.027, 0.022],
        [0.048, 0.030, 0.023],
        [0.045, 0.028, 0.022],
        [0.036, 0.022, 0.020],
    ]
)
THUMB_BASE = np.array([0.026, -0.022, 0.008])
THUMB_BONES = np.array([0.044, 0.034, 0.028])
DISTAL_SHARE = 0.65  # a distal joint follows its middle joint, as tendons do
FINGER_RADIUS = 0.009  # m, around its bones

# angles: 4 x (MCP flexion, MCP abduction, PIP flexion), then thumb (opposition,
# extension from the palm's x axis, MCP flexion, IP flexion); radians
OPEN = np.array([0.25, 0.0, 0.25] * 4 + [1.1, 1.0, 0.1, 0.1])
GRASP = np.array([0.75, 0.0, 0.65] * 4 + [1.45, 0.75, 0.25, 0.35])
LOWER = np.array([-0.2, -0.25, 0.0] * 4 + [0.2, 0.2, -0.1, -0.2])
UPPER = np.array([1.5, 0.25, 1.7] * 4 + [1.9, 1.5, 0.9, 1.1])


def hand_keypoints(angles: np.ndarray) -> np.ndarray:
    """Keypoints of the right hand in its palm frame, m, (..., 21, 3).

    Of angles in rad, (..., 16); keypoint 0 is the origin.
    """
    points = np.zeros((*angles.shape[:-1], 21, 3))
    points[..., 1:5, :] = _thumb(angles[..., 12:])
    for finger in range(4):
        chain = _finger(angles[..., 3 * finger : 3 * finger + 3], finger)
        points[..., 5 + 4 * finger : 9 + 4 * finger, :] = chain
    return points


def _finger(angles: np.ndarray, finger: int) -> np.ndarray:
    flex, abduct, middle = angles[..., 0], angles[..., 1], angles[..., 2]
    along = np.stack([np.cos(abduct), np.sin(abduct), 0 * abduct], axis=-1)
    bend = np.stack([flex, flex + middle, flex + (1 + DISTAL_SHARE) * middle], -1)
    steps = np.cos(bend)[..., None] * along[..., None, :]
    steps = steps + np.sin(bend)[..., None] * np.array([0.0, 0.0, 1.0])
    return _chain(KNUCKLES[finger], steps * PHALANGES[finger][:, None])


def _thumb(angles: np.ndarray) -> np.ndarray:
    oppose, extend, flex, distal = (angles[..., i] for i in range(4))
    side = np.stack([0 * oppose, -np.cos(oppose), np.sin(oppose)], axis=-1)
    ahead = np.array([1.0, 0.0, 0.0])
    first = np.cos(extend)[..., None] * ahead + np.sin(extend)[..., None] * side
    # the thumb bends towards the fingers and across the palm
    across = np.broadcast_to([0.8, 0.6, 0.0], first.shape)
    bent = across - np.sum(across * first, -1, keepdims=True) * first
    bent = bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    bend = np.stack([0 * flex, flex, flex + distal], axis=-1)
    steps = np.cos(bend)[..., None] * first[..., None, :]
    steps = steps + np.sin(bend)[..., None] * bent[..., None, :]
    return _chain(THUMB_BASE, steps * THUMB_BONES[:, None])


def _chain(base: np.ndarray, steps: np.ndarray) -> np.ndarray:
    shape = (*steps.shape[:-2], 1, 3)
    points = np.concatenate([np.broadcast_to(base, shape), steps], axis=-2)
    return np.cumsum(points, axis=-2)


@dataclass
class GraspTarget:
    """Where the tips of a right hand should go, in the object frame."""

    tips: np.ndarray  # wanted fingertips, m, (5, 3); NaN rows are free
    palm: np.ndarray  # wished palm orientation (columns are the palm axes), (3, 3)
    surface: np.ndarray  # points of the object's surface, m, (S, 3)
    normals: np.ndarray  # outward normals of them, (S, 3)
    floor: float  # height of the table in the object frame, m


@dataclass
class Grasp:
    """A posed right hand in the object frame: wrist, palm orientation, joint angles."""

    wrist: np.ndarray
    palm: Rotation
    angles: np.ndarray
    tip_error: float

    def opened(self, share: float) -> np.ndarray:
        """Keypoints in the object frame, m, (21, 3); share 1 is the open hand."""
        local = hand_keypoints(self.angles + share * (OPEN - self.angles))
        return self.palm.apply(local) + self.wrist


def fit_grasp(target: GraspTarget) -> Grasp:
    """Least-squares posture whose tips meet their targets, clear of obstacles."""
    nominal = Rotation.from_matrix(target.palm)
    free = np.isnan(target.tips[:, 0])
    reach = hand_keypoints(GRASP)[[4, 8, 12, 16, 20]]
    offset = np.nanmean(target.tips, 0) - nominal.apply(reach[~free].mean(0))
    start = np.concatenate([offset, np.zeros(3), GRASP])
    lower = np.concatenate([offset - 0.15, np.full(3, -0.6), LOWER])
    upper = np.concatenate([offset + 0.15, np.full(3, 0.6), UPPER])

    def residuals(x: np.ndarray) -> np.ndarray:
        palm = Rotation.from_rotvec(x[3:6]) * nominal
        points = palm.apply(hand_keypoints(x[6:])) + x[:3]
        tips = (points[[4, 8, 12, 16, 20]] - target.tips)[~free].ravel()
        return np.concatenate(
            [
                tips / 0.002,
                x[3:6] / 0.35,
                (x[6:] - GRASP) / 0.5,
                _clearance(points, target, free) / 0.002,
            ]
        )

    fit = least_squares(residuals, start, bounds=(lower, upper), max_nfev=60)
    palm = Rotation.from_rotvec(fit.x[3:6]) * nominal
    points = palm.apply(hand_keypoints(fit.x[6:])) + fit.x[:3]
    errors = np.linalg.norm((points[[4, 8, 12, 16, 20]] - target.tips)[~free], axis=-1)
    return Grasp(fit.x[:3], palm, fit.x[6:], float(errors.max()))


def _clearance(points: np.ndarray, target: GraspTarget, free: np.ndarray) -> np.ndarray:
    """How far keypoints are too near to the object or the table, m, (42,)."""
    gaps = points[:, None] - target.surface[None]
    squared = np.einsum("psi,psi->ps", gaps, gaps)
    near = squared.argmin(axis=1)
    rows = np.arange(len(points))
    inside = np.einsum("pi,pi->p", gaps[rows, near], target.normals[near]) < 0
    depth = np.sqrt(squared[rows, near]) * np.where(inside, -1, 1)
    least = np.full(21, FINGER_RADIUS + 0.003)
    least[[4, 8, 12, 16, 20]] = np.where(free, FINGER_RADIUS, -1.0)
    height = points[:, 2] - target.floor
    low = np.full(21, FINGER_RADIUS + 0.004)
    low[[0, 1, 5, 9, 13, 17]] = 0.04  # a robot's palm is 4 cm thick
    return np.concatenate([(least - depth).clip(0), (low - height).clip(0)])
