"""Who takes part in a stretch of a session: hands that act, objects to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.keys import Side
from flashdex.motions.contact.activity import (
    MOVE_TRAVEL,
    MOVE_TURN,
    TOUCH_SECONDS,
    Activity,
    motion_of,
)
from flashdex.motions.library import NUM_OBJECT_SLOTS

CONTACT = 0.01  # m between surfaces
SPACING = 0.005  # m between the samples of a surface
SAMPLES = (300, 4000)
STEP_SECONDS = 0.1


class Surfaces:
    """Samples of the surfaces of a scene's objects, in their own frames.

    Args:
        meshes: of the objects, m.
    """

    def __init__(self, meshes: list[trimesh.Trimesh]) -> None:
        self._points = [_sample(mesh) for mesh in meshes]
        self._trees = [KDTree(points) for points in self._points]

    def reached(
        self,
        touched: list[int],
        others: list[int],
        poses: list[np.ndarray],
        fps: float,
    ) -> set[int]:
        """Those of ``others`` that a touched object comes within 1 cm of.

        Args:
            touched: objects that hands touch.
            others: objects that they do not.
            poses: of all objects, (T, 7), NaN where not tracked.
            fps: frames a second.
        """
        step = max(round(STEP_SECONDS * fps), 1)
        poses = [pose[::step] for pose in poses]
        return {b for b in others if any(self._meet(a, b, poses) for a in touched)}

    def _meet(self, a: int, b: int, poses: list[np.ndarray]) -> bool:
        known = ~missing_frames(poses[a], poses[b])
        points, tree = self._points[a], self._trees[b]
        low, high = tree.mins - CONTACT, tree.maxes + CONTACT
        for first, second in zip(poses[a][known], poses[b][known], strict=True):
            world = rotation(first[3:]).apply(points) + first[:3]
            local = rotation(second[3:]).inv().apply(world - second[:3])
            near = local[((local > low) & (local < high)).all(axis=1)]
            if not len(near):
                continue
            gaps, _ = tree.query(near, distance_upper_bound=CONTACT)
            if np.isfinite(gaps).any():
                return True
        return False


def _sample(mesh: trimesh.Trimesh) -> np.ndarray:
    count = int(np.clip(mesh.area / SPACING**2, *SAMPLES))
    points, *_ = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points)


@dataclass(frozen=True)
class Use:
    """Who takes part in a stretch of a session.

    Args:
        hand_object: place in the session's objects, of every hand that acts.
        objects: places of the objects to keep, most touched first.
        left_out: names of objects that take part but find no slot, or that move
            although nothing touches them.
    """

    hand_object: dict[Side, int]
    objects: list[int]
    left_out: list[str]


def find_use(
    demo: HumanDemo, activity: Activity, surfaces: Surfaces, start: int, end: int
) -> Use | None:
    """Who takes part in the frames ``start`` to ``end`` (excluded) of a session.

    A hand acts when it is busy for 0.3 s; its object is the one it is busy with
    longest. Kept are the objects of the hands, others that are touched for 0.3 s, and
    those that a touched one comes into contact with, moved ones first.

    Returns:
        None where no hand acts.
    """
    least = max(TOUCH_SECONDS * demo.fps, 1)
    hand_object = _vote(activity, start, end, least)
    if not hand_object:
        return None
    frames = activity.touch[:, :, start:end].sum(axis=(0, 2))
    chosen = set(hand_object.values())
    ranks = sorted(range(len(frames)), key=lambda i: (i not in chosen, -frames[i]))
    touched = [i for i in ranks if i in chosen or frames[i] >= least]
    rest = [i for i in ranks if i not in touched]
    poses = [body.pose[start:end] for body in demo.objects]
    reached = surfaces.reached(touched, rest, poses, demo.fps)
    moved = {i for i in rest if _moved(poses[i])}
    order = touched + [i for i in rest if i in reached & moved]
    lost = order[NUM_OBJECT_SLOTS:] + [i for i in rest if i in moved - reached]
    order += [i for i in rest if i in reached - moved]
    names = [demo.objects[i].name for i in lost]
    return Use(hand_object, order[:NUM_OBJECT_SLOTS], names)


def _vote(activity: Activity, start: int, end: int, least: float) -> dict[Side, int]:
    held = activity.held[:, start:end]
    count = [np.bincount(row[row >= 0], minlength=1) for row in held]
    votes = zip(activity.sides, count, strict=True)
    return {side: int(c.argmax()) for side, c in votes if c.max() >= least}


def _moved(pose: np.ndarray) -> bool:
    travel, turn = motion_of(pose)
    return travel > MOVE_TRAVEL or turn > MOVE_TURN
