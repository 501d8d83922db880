"""Checks of a recording itself, after repair and before anything is made of it."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.demo import MAX_SECONDS, MIN_SECONDS, HumanDemo
from flashdex.datasets.tracks import missing_frames, palm_frame, rotation
from flashdex.motions.findings import Finding, reject, warn
from flashdex.motions.repair.jumps import JUMP_EVENTS, jump_steps
from flashdex.motions.repair.repair import FILLED

PALM_LENGTH = (0.06, 0.12)  # m, wrist to middle MCP
TRAVEL = (1.5, 3.0)  # m, of a hand or an object in one motion: warn and reject
ORIGIN = 1000.0  # m; farther from it, the library's 32 bits lose tenths of millimetres
MISSING = 0.20  # share of a hand's frames that may be made up
# where index to pinky begin and end
KNUCKLES, TIPS = [5, 9, 13, 17], [8, 12, 16, 20]
# m, mean of the tips out of the palm, to where fingers bend: recorded hands 0.029 to
# 0.067, so a hand of the wrong side has the negative of that
BENT_BACK = -0.01
# MANO's order: index, middle, pinky, ring, thumb, three joints each, then the tips
FROM_MANO = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
CHAIN = 1.5  # bones in a wrong order are longer by this
WRONG_TURN, RIGHT_TURN = np.deg2rad(45), np.deg2rad(30)  # of a palm, from its points
HELD_SHARE, HELD_STEPS = 0.8, 8  # of the changes that are equally far apart; at least


def check_demo(demo: HumanDemo) -> list[Finding]:
    """Length, jumps, units and made-up frames of a repaired, validated recording."""
    found = []
    if demo.seconds < MIN_SECONDS:
        found.append(reject("R_SHORT", f"{demo.seconds:.2f} s < {MIN_SECONDS} s"))
    if demo.seconds > MAX_SECONDS:
        text = f"{demo.seconds:.1f} s > {MAX_SECONDS:.0f} s; cut it where contact ends"
        found.append(reject("R_LONG", text))
    poses = [*demo.palm.values(), *(b.pose for b in demo.objects)]
    jumps = np.any([jump_steps(pose, demo.fps) for pose in poses], axis=0)
    events = np.flatnonzero(jumps).tolist()  # a hand or an object jumps after these
    if events:
        text = f"{len(events)} jumps of hand or object, first in frame {events[0]}"
        finding = reject if len(events) > JUMP_EVENTS else warn
        found.append(finding("W_JUMP", text))
    for side, points in demo.keypoints.items():
        length = float(np.median(np.linalg.norm(points[:, 9] - points[:, 0], axis=-1)))
        if not PALM_LENGTH[0] < length < PALM_LENGTH[1]:
            text = f"{side} wrist to middle MCP {length:.3f} m; "
            hint = "are these metres?"
            if _is_mano_order(points):
                hint = "are the joints in MANO's order? Wrist, then thumb to pinky, "
                hint += "from the palm outwards, four each, are needed"
            found.append(reject("E_UNIT", text + hint))
    return found + _check_travel(demo) + _check_missing(demo) + _check_held(demo)


def _is_mano_order(points: np.ndarray) -> bool:
    """Whether keypoints (T, 21, 3) make hands in MANO's order, and none in ours."""

    def longest(points: np.ndarray) -> float:
        # without the tips, which everybody puts in another order
        fingers = points[:, 1:].reshape(-1, 5, 4, 3)[:, :, :3]
        bones = np.linalg.norm(np.diff(fingers, axis=2), axis=-1)
        return float(np.median(bones, axis=0).max())

    return longest(points) > CHAIN * longest(points[:, FROM_MANO])


def _check_held(demo: HumanDemo) -> list[Finding]:
    """Frames that stand several times: a lower rate, spread over a higher one."""
    tracks = [*demo.keypoints.values(), *(b.pose for b in demo.objects)]
    flat = np.concatenate([t.reshape(len(t), -1) for t in tracks], axis=1)
    changes = np.flatnonzero((np.abs(np.diff(flat, axis=0)) > 1e-9).any(axis=1))
    apart = np.diff(changes)
    if len(apart) < HELD_STEPS:
        return []
    times = int(np.bincount(apart).argmax())
    if times < 2 or (apart == times).mean() < HELD_SHARE:
        return []
    text = f"every frame stands {times} times: recorded at {demo.fps / times:g} frames "
    text += f"a second, not {demo.fps:g}? Give each once, with that fps"
    return [warn("W_HELD", text)]


def _check_travel(demo: HumanDemo) -> list[Finding]:
    """Tracks that leave the reach of one person, or are far from the origin."""
    found = []
    tracks = {f"{s} hand": p for s, p in demo.palm.items()}
    tracks |= {f"object '{b.name}'": b.pose for b in demo.objects}
    for what, pose in tracks.items():
        usual = np.median(pose[:, :3], axis=0)
        reach = float(np.linalg.norm(pose[:, :3] - usual, axis=-1).max())
        away = float(np.linalg.norm(usual))
        if reach > TRAVEL[0]:
            finding = reject if reach > TRAVEL[1] else warn
            text = f"{what} goes {reach:.3g} m from where it mostly is; in metres?"
            found.append(finding("E_UNIT", text))
        if away > ORIGIN:
            text = f"{what} is {away:.3g} m from the origin; are these metres?"
            found.append(reject("E_UNIT", text))
    return found


def _check_missing(demo: HumanDemo) -> list[Finding]:
    """Hands that repair had to make up too often; only those that act cost it."""
    start, end = demo.provenance.get("frames", [0, demo.num_frames])
    found = []
    for side in demo.keypoints:
        spans = demo.provenance.get(FILLED, {}).get(f"{side} hand", [])
        made_up = sum(max(min(b, end) - max(a, start), 0) for a, b in spans)
        if made_up > MISSING * (end - start):
            share = 100 * made_up / (end - start)
            text = f"{share:.0f} % of the {side} hand's frames were not tracked"
            finding = reject if side in demo.hand_object else warn
            found.append(finding("W_MISSHAND", text))
    return found


def check_sides(demo: HumanDemo) -> list[Finding]:
    """Fingers that bend out of the back of the hand: it is the other hand."""
    found = []
    for side, points in demo.keypoints.items():
        seen = palm_frame(points, side)
        if _is_scalar_last(demo.palm[side], seen):
            text = f"the {side} palm's quaternions are xyzw; wxyz are needed"
            found.append(reject("E_ROT", text))
            continue
        if _is_mano_order(points):
            text = f"the {side} hand's joints are in MANO's order; wrist, then "
            text += "thumb to pinky, from the palm outwards, are needed"
            found.append(reject("E_SIDE", text))
            continue
        # a palm that is given may be that of the other hand as well as the points
        bend = min(_bend(demo.palm[side], points), _bend(seen, points))
        if not bend > BENT_BACK:
            text = f"the {side} hand's fingers bend {-100 * bend:.0f} cm out of its "
            text += "back; are left and right swapped, or is the world mirrored?"
            found.append(reject("E_SIDE", text))
    return found


def _bend(palm: np.ndarray, points: np.ndarray) -> float:
    """Mean of the tips out of a palm (T, 7), to where fingers bend, m."""
    out_of_palm = rotation(palm[:, 3:]).as_matrix()[..., 2]
    fingers = points[:, TIPS] - points[:, KNUCKLES]
    return float(np.einsum("ti,tfi->tf", out_of_palm, fingers).mean())


def _is_scalar_last(given: np.ndarray, seen: np.ndarray) -> bool:
    """Whether palms (T, 7) fit to those of the keypoints only as x, y, z, w."""
    known = ~missing_frames(given, seen)
    if not known.any():
        return False
    back = rotation(seen[known, 3:]).inv()
    off, rolled = (
        float(np.median((rotation(quats) * back).magnitude()))
        for quats in (given[known, 3:], np.roll(given[known, 3:], 1, axis=1))
    )
    return off > WRONG_TURN and rolled < RIGHT_TURN
