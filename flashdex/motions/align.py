"""A demonstration on the library's terms: z up, table at z = 0, at the control rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import UP_ROTATION, HumanDemo
from flashdex.datasets.support import estimate_support
from flashdex.datasets.tracks import (
    continuous,
    resample,
    resample_pose,
    sample_times,
    transform_pose,
)
from flashdex.keys import SIDES
from flashdex.objects.meshes import clean_mesh, hull_vertices


@dataclass
class AlignedDemo:
    """Tracks of one motion at the control rate; absent hands are zero."""

    name: str
    fps: float
    up: Literal["z", "y", "-y"]  # of the recording; only to name axes in its own world
    keypoints: np.ndarray  # [left, right], m, (T, 2, 21, 3)
    palm: np.ndarray  # (T, 2, 7)
    present: np.ndarray  # hands that were recorded, (2,)
    told: np.ndarray  # object that the recording says each hand uses, -1 for none, (2,)
    poses: list[np.ndarray]  # per object (T, 7)
    meshes: list[trimesh.Trimesh]  # per object, cleaned
    object_names: list[str]
    support_z: float  # height of the table in the recording, m
    support_found: bool  # whether it comes from rest or the reader, not from a guess

    @property
    def num_frames(self) -> int:
        """Frames at the control rate."""
        return len(self.keypoints)


def align(demo: HumanDemo, *, control_hz: float) -> AlignedDemo:
    """Turn a validated demonstration up, shift the table to z = 0, and resample."""
    meshes = [clean_mesh(body.load_mesh(), name=body.name) for body in demo.objects]
    turn = Rotation.from_euler("x", UP_ROTATION[demo.up])
    poses = [transform_pose(b.pose, turn) for b in demo.objects]
    height, found = demo.support_z, True
    if height is None:
        vertices = [hull_vertices(m) for m in meshes]
        height, found = estimate_support(poses, vertices, demo.fps)
    times = sample_times(demo.num_frames, demo.fps, control_hz)
    lift = np.array([0.0, 0.0, -height])
    poses = [resample_pose(p, demo.fps, times) for p in poses]
    for pose in poses:
        pose[:, :3] += lift
    keypoints, palm = _hands(demo, turn, times, lift)
    return AlignedDemo(
        name=demo.name,
        fps=control_hz,
        up=demo.up,
        keypoints=keypoints,
        palm=palm,
        present=np.array([side in demo.keypoints for side in SIDES]),
        told=np.array([demo.hand_object.get(side, -1) for side in SIDES]),
        poses=poses,
        meshes=meshes,
        object_names=[body.name for body in demo.objects],
        support_z=float(height),
        support_found=found,
    )


def _hands(
    demo: HumanDemo, turn: Rotation, times: np.ndarray, lift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    keypoints = np.zeros((len(times), 2, 21, 3))
    palm = np.zeros((len(times), 2, 7))
    palm[..., 3] = 1.0
    for hand, side in enumerate(SIDES):
        if side not in demo.keypoints:
            continue
        points = demo.keypoints[side]
        points = turn.apply(points.reshape(-1, 3)).reshape(points.shape)
        keypoints[:, hand] = resample(points, demo.fps, times) + lift
        pose = transform_pose(demo.palm[side], turn)
        palm[:, hand] = resample_pose(pose, demo.fps, times)
        palm[:, hand, :3] += lift
        palm[:, hand, 3:] = continuous(palm[:, hand, 3:])
    return keypoints, palm
