"""Who uses what: hands that act, and the objects to keep.

``find_roles`` finds it for a motion; ``find_use`` for a stretch of a session that is
to be cut, and tells the motion that comes of it (``HumanDemo.hand_object``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import KDTree

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import missing_frames, rotation
from flashdex.keys import Side
from flashdex.motions.align import AlignedDemo
from flashdex.motions.contact.activity import TOUCH_SECONDS, Activity, has_moved
from flashdex.motions.contact.fingertips import (
    CONTACT_DISTANCE,
    contact_runs,
    tip_distances,
)
from flashdex.motions.library_format import NUM_OBJECT_SLOTS

NO_OBJECT = 10.0  # m, tip distance of a hand without object
MEET = 0.01  # m between the surfaces of two objects
SPACING = 0.005  # m between the samples of a surface
SAMPLES = (300, 4000)
STEP_SECONDS = 0.1


@dataclass
class Interaction(AlignedDemo):
    """An aligned motion of which it is known who uses what; its objects have slots.

    An idle hand has the distances to the object nearest to it, but no slot.
    """

    active: np.ndarray  # hands that touch an object, (2,)
    hand_object: np.ndarray  # slot of each hand's object, -1 for none, (2,)
    tip_dist: np.ndarray  # to the surface of that object, m, (T, 2, 5)
    contact: np.ndarray  # fingers in contact, (T, 2, 5) bool
    left_out: dict[str, np.ndarray]  # poses (T, 7) of objects without a slot, by name


def find_roles(aligned: AlignedDemo) -> Interaction:
    """Give slots to what hands touch longest, then to what moves most."""
    poses, count = aligned.poses, len(aligned.poses)
    tip_dist = np.full((aligned.num_frames, 2, 5), NO_OBJECT)
    contact = np.zeros(tip_dist.shape, dtype=bool)
    chosen = aligned.told.copy()
    touched = np.zeros(count, dtype=int)  # frames
    for hand in np.flatnonzero(aligned.present):
        told = int(aligned.told[hand])
        options = list(range(count)) if told < 0 else [told]
        points = aligned.keypoints[:, hand]
        near = [tip_distances(points, poses[i], aligned.meshes[i]) for i in options]
        touch = [contact_runs(distances, aligned.fps) for distances in near]
        touched[options] += [mask.any(axis=1).sum() for mask in touch]
        best = choose_object(near)
        tip_dist[:, hand], contact[:, hand] = near[best], touch[best]
        if touch[best].any():
            chosen[hand] = options[best]
    travel = [float(np.ptp(pose[:, :3], axis=0).max()) for pose in poses]
    order = sorted(
        range(count), key=lambda i: (i not in chosen, -touched[i], -travel[i])
    )
    slots = sorted(order[:NUM_OBJECT_SLOTS])
    kept: dict[str, Any] = vars(aligned).copy()
    for field in ("poses", "meshes", "object_names"):
        kept[field] = [kept[field][i] for i in slots]
    return Interaction(
        **kept,
        active=aligned.present & contact.any(axis=(0, 2)),
        hand_object=np.array([slots.index(i) if i >= 0 else -1 for i in chosen]),
        tip_dist=tip_dist,
        contact=contact,
        left_out={aligned.object_names[i]: poses[i] for i in order[NUM_OBJECT_SLOTS:]},
    )


def choose_object(distances: list[np.ndarray]) -> int:
    """The object, given distances (T, 5), touched longest; the nearest breaks ties."""
    nearest = [d.min(axis=1) for d in distances]
    scores = [(int((n < CONTACT_DISTANCE).sum()), -float(n.min())) for n in nearest]
    return max(range(len(scores)), key=scores.__getitem__)


@dataclass(frozen=True)
class Use:
    """Who takes part in a stretch of a session; objects by their place in the session.

    Left out are objects that take part but find no slot, and those that move although
    nothing touches them.
    """

    hand_object: dict[Side, int]  # of every hand that acts
    objects: list[int]  # those to keep, most touched first
    left_out: list[str]


def find_use(
    demo: HumanDemo, activity: Activity, surfaces: list[KDTree], start: int, end: int
) -> Use | None:
    """Who takes part in the frames ``start`` to ``end`` (excluded) of a session.

    A hand acts when it is busy for 0.3 s; its object is the one it is busy with
    longest. Kept are the objects of the hands, others that are touched for 0.3 s, and
    those that a touched one comes into contact with, moved ones first.

    Returns:
        None where no hand acts.
    """
    least = max(TOUCH_SECONDS * demo.fps, 1)
    held = zip(activity.sides, activity.held[:, start:end], strict=True)
    hand_object: dict[Side, int] = {}
    for side, row in held:
        votes = np.bincount(row[row >= 0], minlength=1)
        if votes.max() >= least:
            hand_object[side] = int(votes.argmax())
    if not hand_object:
        return None
    frames = activity.touch[:, :, start:end].sum(axis=(0, 2))
    chosen = set(hand_object.values())
    ranks = sorted(range(len(frames)), key=lambda i: (i not in chosen, -frames[i]))
    touched = [i for i in ranks if i in chosen or frames[i] >= least]
    rest = [i for i in ranks if i not in touched]
    poses = [body.pose[start:end] for body in demo.objects]
    reached = _reached(surfaces, poses, touched, rest, demo.fps)
    moved = {i for i in rest if has_moved(poses[i])}
    order = touched + [i for i in rest if i in reached & moved]
    lost = order[NUM_OBJECT_SLOTS:] + [i for i in rest if i in moved - reached]
    order += [i for i in rest if i in reached - moved]
    names = [demo.objects[i].name for i in lost]
    return Use(hand_object, order[:NUM_OBJECT_SLOTS], names)


def sample_surfaces(meshes: list[trimesh.Trimesh]) -> list[KDTree]:
    """Samples of the surfaces of a session's objects, m, in their own frames."""
    trees = []
    for mesh in meshes:
        count = int(np.clip(mesh.area / SPACING**2, *SAMPLES))
        points, *_ = trimesh.sample.sample_surface(mesh, count, seed=0)
        trees.append(KDTree(np.asarray(points)))
    return trees


def _reached(
    surfaces: list[KDTree],
    poses: list[np.ndarray],
    touched: list[int],
    others: list[int],
    fps: float,
) -> set[int]:
    """Those of ``others`` that a touched object comes within 1 cm of."""
    step = max(round(STEP_SECONDS * fps), 1)
    some = [(tree, pose[::step]) for tree, pose in zip(surfaces, poses, strict=True)]
    return {b for b in others if any(_meet(*some[a], *some[b]) for a in touched)}


def _meet(
    tree: KDTree, pose: np.ndarray, other: KDTree, other_pose: np.ndarray
) -> bool:
    known = ~missing_frames(pose, other_pose)
    low, high = other.mins - MEET, other.maxes + MEET
    for first, second in zip(pose[known], other_pose[known], strict=True):
        world = rotation(first[3:]).apply(tree.data) + first[:3]
        local = rotation(second[3:]).inv().apply(world - second[:3])
        near = local[((local > low) & (local < high)).all(axis=1)]
        gaps, _ = other.query(near, distance_upper_bound=MEET)
        if np.isfinite(gaps).any():
            return True
    return False
