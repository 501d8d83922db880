"""Repair of recordings: what is missing or wrong for a moment is closed or cut out.

Motions go in as they were read and come out with tracks that are finite, of unit
quaternions without sign flips, and free of outliers of one or two frames. Nothing
longer than 0.1 s is ever made up.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from flashdex.datasets.demo import (
    MAX_SECONDS,
    MIN_SECONDS,
    QUAT_TOLERANCE,
    DemoObject,
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
from flashdex.keys import Side
from flashdex.motions.checks.recording import FILLED, JUMP_EVENTS, Finding, reject
from flashdex.motions.repair.jumps import outliers

QUAT_LIMIT = 0.1  # a quaternion farther off is no rotation
LEAST_TRACKED = 0.2  # share of frames below which a track is not worth keeping

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
    found: list[Finding] = []
    demo = _drop(_blank(demo), 0.0, found)
    found += _check_quats(demo)
    if not demo.keypoints or not demo.objects or _rejects(found):
        return [], found
    demo = _smooth(demo, found, limited=not keep_gaps)
    if keep_gaps:
        return [demo], found
    demo = _drop(demo, LEAST_TRACKED, found)
    pieces, remarks = _split(demo)
    return pieces, found + remarks


def _rejects(found: list[Finding]) -> bool:
    return any(f.level == "reject" for f in found)


def _blank(demo: HumanDemo) -> HumanDemo:
    """A copy in which a frame that lacks one value of a track lacks them all."""
    keypoints, palm = dict(demo.keypoints), dict(demo.palm)
    for side in demo.keypoints:
        gone = _missing(demo.keypoints[side], demo.palm[side])
        keypoints[side] = np.where(gone[:, None, None], np.nan, demo.keypoints[side])
        palm[side] = np.where(gone[:, None], np.nan, demo.palm[side])
    objects = [
        DemoObject(b.name, b.mesh, np.where(_missing(b.pose)[:, None], np.nan, b.pose))
        for b in demo.objects
    ]
    return replace(demo, keypoints=keypoints, palm=palm, objects=objects)


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
        told = "never" if share == 0 else f"in less than {100 * share:.0f} % of frames"
        level = "info" if share == 0 else "warn"
        text = f"{', '.join(lost)} left out: tracked {told}"
        found.append(Finding("E_NAN", level, text))
    return keep(demo, sides, kept)


def keep(demo: HumanDemo, sides: list[Side], objects: list[int]) -> HumanDemo:
    """A motion with some of its hands and objects only.

    Args:
        demo: the motion.
        sides: hands to keep.
        objects: places in ``demo.objects`` to keep, in their new order.
    """
    place = {old: new for new, old in enumerate(objects)}
    return replace(
        demo,
        keypoints={s: demo.keypoints[s] for s in sides},
        palm={s: demo.palm[s] for s in sides},
        objects=[demo.objects[i] for i in objects],
        hand_object={
            s: place[i]
            for s, i in demo.hand_object.items()
            if s in sides and i in place
        },
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
            found.append(Finding("E_ROT", "warn", f"{text}; made unit", frames))
    return found


def _first(demo: HumanDemo) -> int:
    """Number of a motion's first frame in its recording."""
    return int(demo.provenance.get("frames", [0])[0])


@dataclass
class _Notes:
    """What was changed in the tracks of a motion; frames in the recording's numbers."""

    first: int
    flips: int = 0
    jumps: list[int] = field(default_factory=list)
    filled: dict[str, list[list[int]]] = field(default_factory=dict)

    def findings(self, *, limited: bool) -> list[Finding]:
        found = []
        if self.flips:
            text = f"{self.flips} quaternion flips undone"
            found.append(Finding("I_SIGN", "info", text))
        if self.jumps:
            text = f"{len(self.jumps)} jumps there and back, first in frame "
            many = limited and len(self.jumps) > JUMP_EVENTS
            text += f"{min(self.jumps)}; {'too many' if many else 'interpolated'}"
            level = "reject" if many else "warn"
            found.append(Finding("W_JUMP", level, text, tuple(sorted(self.jumps))))
        spans = [span for spans in self.filled.values() for span in spans]
        if spans:
            closed = sorted({i for a, b in spans for i in range(a, b)})
            text = f"{len(closed)} frames interpolated, first frame {closed[0]}"
            found.append(Finding("E_NAN", "info", text, tuple(closed)))
        return found


def _smooth(demo: HumanDemo, found: list[Finding], *, limited: bool) -> HumanDemo:
    """Every track without flips, outliers and short gaps."""
    notes = _Notes(_first(demo))
    keypoints, palm, objects = dict(demo.keypoints), dict(demo.palm), []
    for side in demo.palm:
        pose, gaps = _close(demo.palm[side], demo.fps, f"{side} hand", notes)
        points = fill_points(demo.keypoints[side], gaps)
        points[missing_frames(pose)] = np.nan  # an outlier beside a long gap
        palm[side], keypoints[side] = pose, points
    for body in demo.objects:
        pose, _ = _close(body.pose, demo.fps, f"object {body.name}", notes)
        objects.append(DemoObject(body.name, body.mesh, pose))
    found += notes.findings(limited=limited)
    told = demo.provenance | ({FILLED: notes.filled} if notes.filled else {})
    return replace(
        demo, keypoints=keypoints, palm=palm, objects=objects, provenance=told
    )


def _close(
    pose: np.ndarray, fps: float, what: str, notes: _Notes
) -> tuple[np.ndarray, list[Span]]:
    """A pose track without flips, outliers and short gaps, and the gaps closed."""
    pose, flips = align_signs(pose)
    notes.flips += flips
    for start, end in outliers(pose, fps):
        pose[start:end] = np.nan
        notes.jumps.append(start + notes.first)
    gaps = short_gaps(missing_frames(pose), fps)
    if gaps:
        notes.filled[what] = [[a + notes.first, b + notes.first] for a, b in gaps]
    return fill_pose(pose, gaps), gaps


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
        return [piece], [Finding("E_NAN", "info", text)]
    lost = (demo.num_frames - sum(b - a for a, b in long)) / demo.fps
    text = f"long gaps: {len(long)} cut out of at least {MIN_SECONDS} s, {lost:.1f} s"
    found = Finding("E_NAN", "warn", f"{text} lost")
    if demo.support_z is None and len(long) > 1:
        demo = replace(demo, support_z=_table(demo))
    return [demo.cut(a, b, name=f"{demo.name}_{a}_{b}") for a, b in long], [found]


def _table(demo: HumanDemo) -> float | None:
    try:
        return demo_support(demo)
    except MeshError:
        return None  # every piece says what is wrong with its mesh
