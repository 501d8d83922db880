"""Findings about motions: codes, levels, and the checks of a recording itself.

A rejected motion stays out of the library; a flagged one is in it and is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from flashdex.datasets.demo import HumanDemo
from flashdex.motions.jumps import jump_steps

Level = Literal["info", "warn", "reject"]
Status = Literal["kept", "flagged", "rejected"]

MIN_SECONDS, MAX_SECONDS = 1.0, 20.0
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
