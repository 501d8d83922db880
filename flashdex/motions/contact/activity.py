"""When hands touch objects, over a whole session, and what moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.ndimage import uniform_filter1d

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.support import STILL_SPEED, STILL_TURN, speeds
from flashdex.datasets.tracks import (
    missing_frames,
    rotation,
    runs,
)
from flashdex.keys import SIDES, Side
from flashdex.motions.contact.fingertips import local_tips
from flashdex.objects.meshes import reduce_mesh
from flashdex.objects.signed_distance import surface_distance

TOUCH, LEAVE = 0.02, 0.03  # m: a touch begins below the first, ends above the second
BRIDGE_SECONDS = 0.5  # shorter interruptions are none
TOUCH_SECONDS = 0.3  # a shorter touch is none
MOVE_TRAVEL, MOVE_TURN = 0.02, np.deg2rad(15)  # less is no motion
MESH_FACES = 5000  # enough for a threshold of centimetres
SAMPLE_STEP = 0.005  # m


@dataclass(frozen=True)
class Activity:
    """A session frame by frame."""

    sides: list[Side]  # hands, in the order of the axis H
    touch: np.ndarray  # hand touches object, (H, O, T) bool
    held: np.ndarray  # object that a hand is busy with, -1 for none, (H, T)
    moving: np.ndarray  # object moves and gets somewhere, (O, T) bool
    pace: np.ndarray  # speed of each object, m/s, 0 where unknown, (O, T)
    hand_seen: np.ndarray  # (H, T) bool
    object_seen: np.ndarray  # (O, T) bool


def find_activity(demo: HumanDemo, meshes: list[trimesh.Trimesh]) -> Activity:
    """Contact and motion of a session; nothing is touched where a track is NaN."""
    sides: list[Side] = [s for s in SIDES if s in demo.keypoints]
    points = [demo.keypoints[s] for s in sides]
    poses = [body.pose for body in demo.objects]
    pairs = zip(poses, meshes, strict=True)
    near = np.stack([nearest_tips(points, p, mesh) for p, mesh in pairs], axis=1)
    touch = np.stack([[touches(row) for row in hand] for hand in near])
    held = [busy_with(n, t, demo.fps) for n, t in zip(near, touch, strict=True)]
    pairs = [_speeds(pose, demo.fps) for pose in poses]
    moving = [_moves(p, s) for p, s in zip(poses, pairs, strict=True)]
    return Activity(
        sides=sides,
        touch=touch,
        held=np.stack(held),
        moving=np.stack(moving),
        pace=np.stack([np.nan_to_num(s[:, 0]) for s in pairs]),
        hand_seen=np.stack([~missing_frames(p) for p in points]),
        object_seen=np.stack([~missing_frames(p) for p in poses]),
    )


def nearest_tips(
    hands: list[np.ndarray], pose: np.ndarray, mesh: trimesh.Trimesh
) -> np.ndarray:
    """Distance of each hand's nearest fingertip to an object, m, (H, T).

    Only tips within 3 cm of the bounding box are measured; the rest is infinitely far.

    Keypoints (m, (T, 21, 3)) and pose (T, 7) are NaN where not tracked.
    """
    near = np.full((len(hands), len(pose)), np.inf)
    seen = ~missing_frames(pose)
    if not seen.any():
        return near
    local = np.full((*near.shape, 5, 3), np.nan)
    local[:, seen] = [local_tips(keypoints[seen], pose[seen]) for keypoints in hands]
    low, high = mesh.bounds
    outside = np.linalg.norm(np.maximum(low - local, local - high).clip(0), axis=-1)
    hand, frame, finger = np.nonzero(outside < LEAVE)  # NaN compares as False
    if len(hand):
        coarse = reduce_mesh(mesh, max_faces=MESH_FACES)
        gaps = surface_distance(coarse, local[hand, frame, finger], step=SAMPLE_STEP)
        np.minimum.at(near, (hand, frame), gaps)
    return near


def touches(near: np.ndarray) -> np.ndarray:
    """Touch of distances (m, (T,)) with hysteresis: below 2 cm, then up to 3 cm."""
    mask = np.zeros(len(near), dtype=bool)
    for start, end in runs(near < LEAVE):
        mask[start:end] = near[start:end].min() < TOUCH
    return mask


def busy_with(near: np.ndarray, touch: np.ndarray, fps: float) -> np.ndarray:
    """The object that one hand is busy with: the nearest of those it touches.

    Distances are averaged over 0.5 s, so that a finger that strays to a neighbour does
    not count; a touch of less than 0.3 s is none, or part of the touch beside it.
    Distances (m) and touches are (O, T); the result is the object, -1 for none, (T,).
    """
    size = max(round(BRIDGE_SECONDS * fps), 1)
    near = np.where(touch, near, LEAVE)
    mean = uniform_filter1d(near, size, axis=1, mode="nearest")
    busy = bridge(np.asarray(touch.any(axis=0)), fps)
    held = np.where(busy, mean.argmin(axis=0), -1)
    edges = np.flatnonzero(np.diff(held)) + 1
    for span in np.split(np.arange(len(held)), edges):
        if held[span[0]] >= 0 and len(span) < TOUCH_SECONDS * fps:
            before = held[span[0] - 1] if span[0] else -1
            after = held[span[-1] + 1] if span[-1] + 1 < len(held) else -1
            held[span] = before if before >= 0 else after
    return held


def bridge(mask: np.ndarray, fps: float) -> np.ndarray:
    """A mask (T,) whose interruptions of less than 0.5 s are closed."""
    mask = mask.copy()
    for start, end in runs(~mask):
        if start > 0 and end < len(mask) and end - start < BRIDGE_SECONDS * fps:
            mask[start:end] = True
    return mask


def _speeds(pose: np.ndarray, fps: float) -> np.ndarray:
    """Linear (m/s) and angular speed (rad/s), NaN where not tracked, (T, 2)."""
    found = np.full((len(pose), 2), np.nan)
    for a, b in runs(~missing_frames(pose), least=3):
        found[a:b] = np.column_stack(speeds(pose[a:b], fps))
    return found


def _moves(pose: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Frames of motions that get somewhere, (T,) bool; jitter does not."""
    mask = np.zeros(len(pose), dtype=bool)
    for a, b in runs((speeds[:, 0] > STILL_SPEED) | (speeds[:, 1] > STILL_TURN)):
        mask[a:b] = has_moved(pose[a:b])
    return mask


def motion_of(pose: np.ndarray) -> tuple[float, float]:
    """Largest travel (m) and turn (rad) from the first tracked frame of (T, 7)."""
    pose = pose[~missing_frames(pose)]
    if not len(pose):
        return 0.0, 0.0
    turn = rotation(pose[:, 3:])
    travel = np.linalg.norm(pose[:, :3] - pose[0, :3], axis=-1).max()
    return float(travel), float((turn * turn[0].inv()).magnitude().max())


def has_moved(pose: np.ndarray) -> bool:
    """Whether a track (T, 7) gets 2 cm or 15 degrees away from where it began."""
    travel, turn = motion_of(pose)
    return travel > MOVE_TRAVEL or turn > MOVE_TURN
