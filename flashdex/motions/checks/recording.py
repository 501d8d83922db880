"""Findings about motions: codes, levels, and the checks of a recording itself.

A rejected motion stays out of the library; a flagged one is in it and is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from flashdex.datasets.demo import MAX_SECONDS, MIN_SECONDS, HumanDemo
from flashdex.datasets.tracks import linear_velocity, rotation
from flashdex.keys import Side
from flashdex.motions.align import AlignedDemo
from flashdex.motions.repair.jumps import jump_steps

Level = Literal["info", "warn", "reject"]
Status = Literal["kept", "flagged", "rejected"]

JUMP_EVENTS = 5
PALM_LENGTH = (0.06, 0.12)  # m, wrist to middle MCP
TRAVEL = (1.5, 3.0)  # m, of a hand or an object in one motion: warn and reject
ORIGIN = 1000.0  # m; farther from it, the library's 32 bits lose tenths of millimetres
MISSING = 0.20  # share of a hand's frames that may be made up
FILLED = "filled"  # key of the provenance: tracks with the frames made up for them


@dataclass(frozen=True)
class Finding:
    """One remark about a motion.

    Args:
        code: one of the codes of the documentation.
        level: whether it costs the motion anything.
        text: what was measured, and what to do.
        frames: it concerns, in the recording's numbers; none if it concerns all.
    """

    code: str
    level: Level
    text: str
    frames: tuple[int, ...] = ()


def status_of(findings: Iterable[Finding]) -> Status:
    """Kept, flagged (a warning) or rejected."""
    levels = {f.level for f in findings}
    return (
        "rejected" if "reject" in levels else "flagged" if "warn" in levels else "kept"
    )


def make_strict(findings: Iterable[Finding]) -> list[Finding]:
    """The same findings with every warning turned into a rejection."""
    return [replace(f, level="reject") if f.level == "warn" else f for f in findings]


def concerning(findings: Iterable[Finding], demo: HumanDemo) -> list[Finding]:
    """Findings about a whole recording that concern one piece of it.

    Args:
        findings: of ``repair`` and ``segment``.
        demo: a piece that they returned.
    """
    start, end = demo.provenance.get("frames", [0, demo.num_frames])
    return [
        f for f in findings if not f.frames or any(start <= i < end for i in f.frames)
    ]


def reject(code: str, text: str) -> Finding:
    """A finding that keeps the motion out of the library."""
    return Finding(code, "reject", text)


def check_demo(demo: HumanDemo) -> list[Finding]:
    """Length, jumps, units and made-up frames of a repaired recording.

    Args:
        demo: validated.
    """
    found = []
    if demo.seconds < MIN_SECONDS:
        found.append(reject("R_SHORT", f"{demo.seconds:.2f} s < {MIN_SECONDS} s"))
    if demo.seconds > MAX_SECONDS:
        text = f"{demo.seconds:.1f} s > {MAX_SECONDS:.0f} s; cut it where contact ends"
        found.append(reject("R_LONG", text))
    events = _jumps(demo)
    if events:
        text = f"{len(events)} jumps of hand or object, first in frame {events[0]}"
        level = "reject" if len(events) > JUMP_EVENTS else "warn"
        found.append(Finding("W_JUMP", level, text))
    for side, points in demo.keypoints.items():
        length = float(np.median(np.linalg.norm(points[:, 9] - points[:, 0], axis=-1)))
        if not PALM_LENGTH[0] < length < PALM_LENGTH[1]:
            text = f"{side} wrist to middle MCP {length:.3f} m; are these metres?"
            found.append(reject("E_UNIT", text))
    return found + _check_travel(demo) + _check_missing(demo)


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
            level = "reject" if reach > TRAVEL[1] else "warn"
            text = f"{what} goes {reach:.3g} m from where it mostly is; in metres?"
            found.append(Finding("E_UNIT", level, text))
        if away > ORIGIN:
            text = f"{what} is {away:.3g} m from the origin; are these metres?"
            found.append(reject("E_UNIT", text))
    return found


def _jumps(demo: HumanDemo) -> list[int]:
    """Frames after which a wrist or an object jumps."""
    tracks = [*demo.palm.values(), *(b.pose for b in demo.objects)]
    bad = np.zeros(demo.num_frames - 1, dtype=bool)
    for pose in tracks:
        bad |= jump_steps(pose, demo.fps)
    return np.flatnonzero(bad).tolist()


def _check_missing(demo: HumanDemo) -> list[Finding]:
    """Hands that repair had to make up too often; only those that act cost it."""
    start, end = demo.provenance.get("frames", [0, demo.num_frames])
    found = []
    for side in demo.keypoints:
        spans = demo.provenance.get(FILLED, {}).get(f"{side} hand", [])
        made_up = sum(max(min(b, end) - max(a, start), 0) for a, b in spans)
        if made_up > MISSING * (end - start):
            level = "reject" if side in demo.hand_object else "warn"
            share = 100 * made_up / (end - start)
            text = f"{share:.0f} % of the {side} hand's frames were not tracked"
            found.append(Finding("W_MISSHAND", level, text))
    return found


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
