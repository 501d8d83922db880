"""Repair of recordings: what is missing or wrong for a moment is closed or cut out.

Motions go in as they were read and come out with tracks that are finite, of unit
quaternions without sign flips, and free of outliers of one or two frames. Nothing
longer than 0.1 s is ever made up.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from flashdex.datasets.demo import (
    MAX_SECONDS,
    MIN_SECONDS,
    QUAT_TOLERANCE,
    HumanDemo,
)
from flashdex.datasets.support import demo_support
from flashdex.datasets.tracks import (
    FARTHEST,
    align_signs,
    fill_points,
    fill_pose,
    missing_frames,
    runs,
    short_gaps,
)
from flashdex.errors import MeshError
from flashdex.keys import FINGERS, Side
from flashdex.motions.findings import Finding, info, reject, status_of, warn
from flashdex.motions.repair.jumps import JUMP_EVENTS, outliers

QUAT_LIMIT = 0.1  # a quaternion farther off is no rotation
HALF_SEEN = 0.1  # share of frames with single points missing that is told
LEAST_TRACKED = 0.2  # share of frames below which a track is not worth keeping

FILLED = "filled"  # key of the provenance: tracks with the frames made up for them

Span = tuple[int, int]


def repair(
    demo: HumanDemo, *, keep_gaps: bool | None = None
) -> tuple[list[HumanDemo], list[Finding]]:
    """Close short gaps, take out outliers, and cut a motion around long gaps.

    Args:
        demo: its shapes are sound (``validate(complete=False)``); not changed.
        keep_gaps: leave long gaps as NaN: ``segment`` cuts around those that matter.
            By default for sessions and for what lasts longer than 20 s.

    Returns:
        The motion, or its pieces ``<name>_<start>_<end>``, none if it cannot be used;
        and findings about the recording (``concerning`` picks those of a piece). The
        provenance of a motion names the frames that were made up.
    """
    if keep_gaps is None:
        keep_gaps = demo.needs_cutting or demo.seconds > MAX_SECONDS
    found = _tell_half_seen(demo)
    demo = _drop(_blank(demo), 0.0, found)
    found += _check_quats(demo)
    if status_of(found) == "rejected":
        return [], found
    demo = _smooth(demo, found, limited=not keep_gaps)
    if keep_gaps:
        return [demo], found
    demo = _drop(demo, LEAST_TRACKED, found)
    pieces, remarks = _split(demo)
    return pieces, found + remarks


def _blank(demo: HumanDemo) -> HumanDemo:
    """A copy in which a frame that lacks one value of a track lacks them all."""
    keypoints, palm = dict(demo.keypoints), dict(demo.palm)
    for side in demo.keypoints:
        gone = _missing(demo.keypoints[side], demo.palm[side])
        keypoints[side] = np.where(gone[:, None, None], np.nan, demo.keypoints[side])
        palm[side] = np.where(gone[:, None], np.nan, demo.palm[side])
    objects = [
        replace(b, pose=np.where(_missing(b.pose)[:, None], np.nan, b.pose))
        for b in demo.objects
    ]
    return replace(demo, keypoints=keypoints, palm=palm, objects=objects)


def _tell_half_seen(demo: HumanDemo) -> list[Finding]:
    """Hands that count as not tracked because single points of theirs are missing."""
    found = []
    for side, points in demo.keypoints.items():
        gone = np.asarray(~np.isfinite(points).all(axis=2))
        half = np.asarray(gone.any(axis=1) & ~gone.all(axis=1))
        if half.sum() <= HALF_SEEN * len(half):
            continue
        often = gone[half].mean(axis=0)
        usual = np.flatnonzero(often > 0.5 * often.max()).tolist()
        names = [_point_name(i) for i in usual]
        text = f"{side} hand: {', '.join(names[:5])} missing in {half.sum()} frames in "
        text += "which the rest is tracked: the whole hand counts as not tracked there"
        found.append(info("E_NAN", text))
    return found


def _point_name(index: int) -> str:
    finger, joint = divmod(index - 1, 4)
    part = "tip" if joint == 3 else f"joint {joint + 1}"
    return f"keypoint {index} ({FINGERS[finger]} {part})" if index else "keypoint 0"


def _missing(*tracks: np.ndarray) -> np.ndarray:
    """Frames without a number, or with one that is no position, (T,) bool."""
    return missing_frames(*(np.where(np.abs(t) < FARTHEST, t, np.nan) for t in tracks))


def _drop(demo: HumanDemo, share: float, found: list[Finding]) -> HumanDemo:
    """Without hands and objects that are tracked in at most a share of the frames.

    The last hand and the last object are kept unless they are never tracked, and so is
    an object that the recording says a hand uses.
    """
    hands: dict[Side, float] = {s: _tracked(p) for s, p in demo.palm.items()}
    bodies = [_tracked(b.pose) for b in demo.objects]
    floor = 0.0 if max(hands.values(), default=0) <= share else share
    sides: list[Side] = [s for s, part in hands.items() if part > floor]
    floor = 0.0 if max(bodies, default=0) <= share else share
    used = set(demo.hand_object.values())
    kept = [i for i, part in enumerate(bodies) if part > (0.0 if i in used else floor)]
    lost = [f"{s} hand" for s in hands if s not in sides]
    lost += [f"object '{b.name}'" for i, b in enumerate(demo.objects) if i not in kept]
    if not sides or not kept:
        what = "hand" if not sides else "object"
        found.append(reject("E_NAN", f"no {what} is tracked in any frame"))
    elif lost:
        told = f"in less than {100 * share:.0f} % of frames" if share else "never"
        finding = warn if share else info
        found.append(finding("E_NAN", f"{', '.join(lost)} left out: tracked {told}"))
    return keep(demo, sides, kept)


def keep(demo: HumanDemo, sides: Sequence[Side], objects: list[int]) -> HumanDemo:
    """A motion with some of its hands, and with objects by place in their new order."""
    used = {s: i for s, i in demo.hand_object.items() if s in sides and i in objects}
    return replace(
        demo,
        keypoints={s: demo.keypoints[s] for s in sides},
        palm={s: demo.palm[s] for s in sides},
        objects=[demo.objects[i] for i in objects],
        hand_object={s: objects.index(i) for s, i in used.items()},
    )


def _tracked(pose: np.ndarray) -> float:
    return float((~missing_frames(pose)).sum()) / max(len(pose), 1)


def _check_quats(demo: HumanDemo) -> list[Finding]:
    found = []
    poses = {f"{s} hand": p for s, p in demo.palm.items()}
    poses |= {f"object '{b.name}'": b.pose for b in demo.objects}
    for what, pose in poses.items():
        off = np.abs(np.linalg.norm(pose[:, 3:], axis=-1) - 1)
        bad = np.flatnonzero(off > QUAT_TOLERANCE)  # NaN compares as False
        if not len(bad):
            continue
        text = f"{what}: quaternion norm off by {np.nanmax(off):.2g} in {len(bad)} "
        text += f"frames, first in frame {bad[0]}"
        if np.nanmax(off) > QUAT_LIMIT:
            found.append(reject("E_ROT", f"{text}; quaternions are wxyz, unit"))
        else:
            frames = tuple((bad + _first(demo)).tolist())
            found.append(warn("E_ROT", f"{text}; made unit", frames))
    return found


def _first(demo: HumanDemo) -> int:
    """Number of a motion's first frame in its recording."""
    return int(demo.provenance.get("frames", [0])[0])


def _smooth(demo: HumanDemo, found: list[Finding], *, limited: bool) -> HumanDemo:
    """Every track without flips, outliers and short gaps; tells what was changed.

    Frames are told in the recording's numbers; the provenance names those made up.
    """
    first, flips, jumps, filled = _first(demo), 0, [], {}

    def close(pose: np.ndarray, what: str) -> tuple[np.ndarray, list[Span]]:
        nonlocal flips
        pose, count = align_signs(pose)
        flips += count
        for start, end in outliers(pose, demo.fps):
            pose[start:end] = np.nan
            jumps.append(start + first)
        gaps = short_gaps(missing_frames(pose), demo.fps)
        if gaps:
            filled[what] = [[a + first, b + first] for a, b in gaps]
        return fill_pose(pose, gaps), gaps

    keypoints, palm = dict(demo.keypoints), dict(demo.palm)
    for side in demo.palm:
        palm[side], gaps = close(demo.palm[side], f"{side} hand")
        points = fill_points(demo.keypoints[side], gaps)
        points[missing_frames(palm[side])] = np.nan  # an outlier beside a long gap
        keypoints[side] = points
    objects = [
        replace(b, pose=close(b.pose, f"object {b.name}")[0]) for b in demo.objects
    ]
    found += _changes(flips, jumps, filled, limited=limited)
    told = demo.provenance | ({FILLED: filled} if filled else {})
    return replace(
        demo, keypoints=keypoints, palm=palm, objects=objects, provenance=told
    )


def _changes(
    flips: int, jumps: list[int], filled: dict[str, list[list[int]]], *, limited: bool
) -> list[Finding]:
    found = []
    if flips:
        found.append(info("I_SIGN", f"{flips} quaternion flips undone"))
    if jumps:
        many = limited and len(jumps) > JUMP_EVENTS
        text = f"{len(jumps)} jumps there and back, first in frame {min(jumps)}; "
        text += "too many" if many else "interpolated"
        level = "reject" if many else "warn"
        found.append(Finding("W_JUMP", level, text, tuple(sorted(jumps))))
    closed = sorted({i for s in filled.values() for a, b in s for i in range(a, b)})
    if closed:
        text = f"{len(closed)} frames interpolated, first frame {closed[0]}"
        found.append(info("E_NAN", text, tuple(closed)))
    return found


def _split(demo: HumanDemo) -> tuple[list[HumanDemo], list[Finding]]:
    """Pieces of at least 1 s in which every track is there."""
    tracks = [*demo.palm.values(), *(b.pose for b in demo.objects)]
    spans = runs(~missing_frames(*tracks))
    if spans == [(0, demo.num_frames)]:
        return [demo], []
    long = [(a, b) for a, b in spans if (b - a) / demo.fps >= MIN_SECONDS]
    if not long:
        longest = max((b - a for a, b in spans), default=0) / demo.fps
        text = f"hands and objects are tracked together for {longest:.2f} s at most"
        return [], [reject("E_NAN", f"{text}; {MIN_SECONDS} s are needed")]
    if len(spans) == 1:
        start, end = spans[0]
        text = f"not tracked before frame {start} or from frame {end} on; cut off"
        piece = demo.cut(start, end, name=demo.name)
        return [piece], [info("E_NAN", text)]
    lost = (demo.num_frames - sum(b - a for a, b in long)) / demo.fps
    text = f"long gaps: {len(long)} cut out of at least {MIN_SECONDS} s, {lost:.1f} s"
    if demo.support_z is None and len(long) > 1:
        with suppress(MeshError):  # every piece says what is wrong with its mesh
            demo = replace(demo, support_z=demo_support(demo))
    pieces = [demo.cut(a, b, name=f"{demo.name}_{a}_{b}") for a, b in long]
    return pieces, [warn("E_NAN", f"{text} lost")]
