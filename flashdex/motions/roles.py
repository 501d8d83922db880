"""Who takes part in a stretch of a session: hands that act, objects to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flashdex.datasets.demo import HumanDemo
from flashdex.keys import Side
from flashdex.motions.activity import (
    MOVE_TRAVEL,
    MOVE_TURN,
    TOUCH_SECONDS,
    Activity,
    motion_of,
)
from flashdex.motions.library import NUM_OBJECT_SLOTS
from flashdex.motions.neighbours import Surfaces


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
