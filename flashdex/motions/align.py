"""A demonstration on the library's terms: z up, table at z = 0, at the control rate."""

from __future__ import annotations

from dataclasses import dataclass, field

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
from flashdex.motions.contact.fingertips import (
    NO_OBJECT,
    assign_object,
    contact_runs,
    tip_distances,
)
from flashdex.motions.library import NUM_OBJECT_SLOTS
from flashdex.objects.meshes import clean_mesh, hull_vertices


@dataclass
class AlignedDemo:
    """Tracks of one motion at the control rate, [left, right]; absent hands are zero.

    Args:
        name: of the motion.
        fps: control rate.
        keypoints: m, (T, 2, 21, 3).
        palm: (T, 2, 7).
        present: hands that were recorded, (2,).
        active: hands that touch an object, (2,).
        hand_object: slot of each hand's object, -1 for none, (2,).
        tip_dist: to the surface of that object, m, (T, 2, 5).
        contact: fingers in contact, (T, 2, 5) bool.
        poses: per slot (T, 7).
        meshes: per slot.
        object_names: per slot.
        support_z: height of the table in the recording, m.
        support_found: whether it comes from rest or the reader, not from a guess.
        left_out: poses (T, 7) of objects that found no slot, by name.
    """

    name: str
    fps: float
    keypoints: np.ndarray
    palm: np.ndarray
    present: np.ndarray
    active: np.ndarray
    hand_object: np.ndarray
    tip_dist: np.ndarray
    contact: np.ndarray
    poses: list[np.ndarray]
    meshes: list[trimesh.Trimesh]
    object_names: list[str]
    support_z: float
    support_found: bool
    left_out: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def num_frames(self) -> int:
        """Frames at the control rate."""
        return len(self.keypoints)


def align(demo: HumanDemo, *, control_hz: float) -> AlignedDemo:
    """Turn up, shift the table to z = 0, resample, and find out who touches what.

    Args:
        demo: validated.
        control_hz: frames a second of the result.
    """
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
    present = np.array([side in demo.keypoints for side in SIDES])
    roles = _assign(demo, keypoints, present, poses, meshes, control_hz)
    tip_dist, slots, chosen = roles.tip_dist, roles.kept, roles.chosen
    contact = np.stack([contact_runs(tip_dist[:, h], control_hz) for h in range(2)], 1)
    used = np.array([slots.index(chosen[h]) if h in chosen else -1 for h in range(2)])
    return AlignedDemo(
        name=demo.name,
        fps=control_hz,
        keypoints=keypoints,
        palm=palm,
        present=present,
        active=present & contact.any(axis=(0, 2)),
        hand_object=used,
        tip_dist=tip_dist,
        contact=contact,
        poses=[poses[i] for i in slots],
        meshes=[meshes[i] for i in slots],
        object_names=[demo.objects[i].name for i in slots],
        support_z=float(height),
        support_found=found,
        left_out={demo.objects[i].name: poses[i] for i in roles.left_out},
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


@dataclass
class _Roles:
    """Objects kept (rows of the demo), each hand's object, and its tip distances."""

    kept: list[int]
    left_out: list[int]
    chosen: dict[int, int]
    tip_dist: np.ndarray


def _assign(
    demo: HumanDemo,
    keypoints: np.ndarray,
    present: np.ndarray,
    poses: list[np.ndarray],
    meshes: list[trimesh.Trimesh],
    fps: float,
) -> _Roles:
    """Give slots to what hands touch longest, then to what moves most.

    An idle hand is given the object nearest to it for its distances, but no slot.
    """
    touched = np.zeros(len(poses), dtype=int)  # frames
    chosen: dict[int, int] = {}
    tip_dist = np.full((len(keypoints), 2, 5), NO_OBJECT)
    for hand in np.flatnonzero(present):
        side = SIDES[hand]
        told = demo.hand_object.get(side)
        options = range(len(poses)) if told is None else [told]
        near = [tip_distances(keypoints[:, hand], poses[i], meshes[i]) for i in options]
        runs = [contact_runs(d, fps).any(axis=1).sum() for d in near]
        best = assign_object(near)
        tip_dist[:, hand] = near[best]
        touched[list(options)] += runs
        if told is not None or runs[best]:
            chosen[int(hand)] = options[best]
    used = set(chosen.values())
    travel = [float(np.ptp(p[:, :3], axis=0).max()) for p in poses]
    order = sorted(
        range(len(poses)), key=lambda i: (i not in used, -touched[i], -travel[i])
    )
    kept = sorted(order[:NUM_OBJECT_SLOTS])
    return _Roles(kept, order[NUM_OBJECT_SLOTS:], chosen, tip_dist)
