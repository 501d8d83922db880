"""Checks of hands against anatomy and against what they move: wrong side, wrong time.

Limits come from 24 hands of TACO, ManipNet, MyoDM and one lifted video.
"""

from __future__ import annotations

import numpy as np

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import linear_velocity, rotation
from flashdex.keys import Side
from flashdex.motions.align import AlignedDemo
from flashdex.motions.checks import Finding, reject

# where index to pinky begin and end
KNUCKLES, TIPS = [5, 9, 13, 17], [8, 12, 16, 20]
# m, mean of the tips out of the palm, to where fingers bend: recorded hands 0.029 to
# 0.067, so a hand of the wrong side has the negative of that
BENT_BACK = -0.01
# m/s; recorded: at most 21 % of the time in which an object is faster than this, no
# finger is within 3 cm of it. Hands that are 0.2 s late: 39 to 59 %.
MOVING, NEAR = 0.15, 0.03
LEAST_SECONDS, ALONE = 0.2, 0.35


def check_sides(demo: HumanDemo) -> list[Finding]:
    """Fingers that bend out of the back of the hand: it is the other hand.

    Args:
        demo: validated.
    """
    return [found for side in demo.keypoints for found in _check_side(demo, side)]


def _check_side(demo: HumanDemo, side: Side) -> list[Finding]:
    out_of_palm = rotation(demo.palm[side][:, 3:]).as_matrix()[..., 2]
    points = demo.keypoints[side]
    fingers = points[:, TIPS] - points[:, KNUCKLES]
    bend = float(np.einsum("ti,tfi->tf", out_of_palm, fingers).mean())
    if bend > BENT_BACK:
        return []
    text = f"the {side} hand's fingers bend {-100 * bend:.0f} cm out of its back; "
    text += "are left and right swapped, or is the world mirrored?"
    return [reject("E_SIDE", text)]


def check_company(aligned: AlignedDemo) -> list[Finding]:
    """Objects that move while the fingers that use them are elsewhere.

    Args:
        aligned: the motion.
    """
    found = []
    for slot, pose in enumerate(aligned.poses):
        users = np.flatnonzero(aligned.hand_object == slot)
        if not len(users):
            continue  # what no hand uses is moved by another object
        speed = np.linalg.norm(linear_velocity(pose[:, :3], aligned.fps), axis=-1)
        moving = speed > MOVING
        away = aligned.tip_dist[:, users].min(axis=(1, 2)) > NEAR
        seconds = float(moving.sum()) / aligned.fps
        share = float((moving & away).sum()) / max(int(moving.sum()), 1)
        if seconds > LEAST_SECONDS and share > ALONE:
            text = f"'{aligned.object_names[slot]}' moves for {seconds:.1f} s, "
            text += f"{100 * share:.0f} % of it with no finger within 3 cm; are hands "
            text += "and objects of one clock and one world?"
            found.append(Finding("W_ALONE", "warn", text))
    return found
