"""Cuts sessions of many actions into motions, by contact and by what moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import trimesh
from scipy.ndimage import binary_dilation, uniform_filter1d
from scipy.spatial import KDTree

from flashdex.datasets.demo import MAX_SECONDS, MIN_SECONDS, HumanDemo
from flashdex.datasets.support import demo_support
from flashdex.datasets.tracks import missing_frames, runs
from flashdex.errors import MeshError
from flashdex.keys import Side
from flashdex.motions.contact.activity import (
    TOUCH_SECONDS,
    Activity,
    bridge,
    find_activity,
)
from flashdex.motions.contact.roles import Use, find_use, sample_surfaces
from flashdex.motions.findings import Finding, info, reject, warn
from flashdex.motions.repair.repair import FILLED, keep
from flashdex.objects.meshes import clean_mesh

MARGIN_SECONDS = 0.33
CALM_SECONDS = 0.5  # a still point is the middle of this long a calm


def segment(demo: HumanDemo) -> tuple[list[HumanDemo], list[Finding]]:
    """Cut a session into motions of 1 to 20 s around contact and motion.

    A piece begins 0.33 s before a hand is within 2 cm of an object or an object moves,
    and ends 0.33 s after; interruptions of less than 0.5 s do not count. It is cut
    where a hand turns to another object, where an acting hand or a kept object was not
    tracked, and at its stillest point where it is too long.

    The session is repaired, with NaN in long gaps; it is not changed.

    Returns:
        Pieces ``<name>_<start>_<end>`` that share the table of the whole session, and
        findings about the session (``concerning`` picks those of a piece).
    """
    found: list[Finding] = []
    demo, meshes = _load_meshes(demo, found)
    if not meshes:
        return [], [*found, reject("E_MESH", "no object has a usable mesh")]
    if demo.support_z is None:
        demo = replace(demo, support_z=demo_support(demo, meshes))
    session = _Session(demo, find_activity(demo, meshes), sample_surfaces(meshes))
    windows = _windows(session.activity, demo.fps)
    pieces = [p for a, b in windows for p in session.pieces(a, b)]
    return pieces, found + _remarks(demo, windows, pieces)


def _load_meshes(
    demo: HumanDemo, found: list[Finding]
) -> tuple[HumanDemo, list[trimesh.Trimesh]]:
    """A session must not fail for one of its meshes: that object is left out."""
    meshes, sound = [], []
    for place, body in enumerate(demo.objects):
        try:
            meshes.append(clean_mesh(body.load_mesh(), name=body.name))
            sound.append(place)
        except MeshError as error:
            found.append(warn("E_MESH", f"object '{body.name}' left out: {error}"))
    return keep(demo, list(demo.keypoints), sound), meshes


def _windows(activity: Activity, fps: float) -> list[tuple[int, int]]:
    """Stretches around contact or motion, cut where a hand turns to another object."""
    busy = np.concatenate([activity.held >= 0, activity.moving]).any(axis=0)
    active = bridge(np.asarray(busy), fps)
    margin = round(MARGIN_SECONDS * fps)
    if margin:
        active = np.asarray(binary_dilation(active, iterations=margin))
    cuts = sorted({cut for hand in activity.held for cut in _changes(hand)})
    windows = []
    for start, end in runs(active):
        windows += pairwise([start, *(c for c in cuts if start < c < end), end])
    return windows


def _changes(held: np.ndarray) -> list[int]:
    """Frames midway between a hand's contact with one object and with the next."""
    busy = np.flatnonzero(held >= 0)
    turns = np.flatnonzero(np.diff(held[busy]))
    return [int(busy[i] + busy[i + 1] + 1) // 2 for i in turns]


@dataclass(frozen=True)
class _Session:
    """A session and what goes on in it; cuts stretches of it into pieces."""

    demo: HumanDemo
    activity: Activity
    surfaces: list[KDTree]

    def pieces(self, start: int, end: int) -> list[HumanDemo]:
        """Motions within the frames ``start`` to ``end`` (excluded)."""
        seconds = (end - start) / self.demo.fps
        if seconds < MIN_SECONDS:
            return []
        use = find_use(self.demo, self.activity, self.surfaces, start, end)
        if use is None:
            return []
        spans = self._tracked_spans(use, start, end)
        if len(spans) == 1 and seconds > MAX_SECONDS:
            still = self._stillest(use, start, end)
            spans = [(start, still), (still, end)]
        if len(spans) > 1:
            return [p for a, b in spans for p in self.pieces(a, b)]
        return [self._cut(use, start, end)]

    def _tracked_spans(self, use: Use, start: int, end: int) -> list[tuple[int, int]]:
        """Cut points are where all that take part begin or cease to be tracked."""
        hands = [i for i, s in enumerate(self.activity.sides) if s in use.hand_object]
        seen = [self.activity.hand_seen[i, start:end] for i in hands]
        seen += [self.activity.object_seen[i, start:end] for i in use.objects]
        pattern = np.logical_and.reduce(seen)
        if not pattern.any():  # never all at once: wherever one of them comes or goes
            pattern = np.packbits(seen, axis=0)[0]
        edges = np.flatnonzero(np.diff(pattern.astype(int))) + start + 1
        return list(pairwise([start, *edges.tolist(), end]))

    def _stillest(self, use: Use, start: int, end: int) -> int:
        """Frame of least motion in the middle half."""
        pace = self.activity.pace[use.objects].max(axis=0)
        for side in use.hand_object:
            wrist = self.demo.palm[side][:, :3]
            step = np.linalg.norm(np.diff(wrist, axis=0, append=wrist[-1:]), axis=-1)
            pace = np.maximum(pace, np.nan_to_num(step) * self.demo.fps)
        size = max(round(CALM_SECONDS * self.demo.fps), 1)
        calm = uniform_filter1d(pace[start:end], size, mode="nearest")
        quarter = (end - start) // 4
        return start + quarter + int(calm[quarter:-quarter].argmin())

    def _cut(self, use: Use, start: int, end: int) -> HumanDemo:
        piece = self.demo.cut(start, end, name=f"{self.demo.name}_{start}_{end}")
        tracked = piece.palm.items()
        whole: list[Side] = [s for s, p in tracked if not missing_frames(p).any()]
        piece = keep(piece, whole, use.objects)
        slots = {s: use.objects.index(i) for s, i in use.hand_object.items()}
        first, last = piece.provenance["frames"]
        filled = {
            what: [s for s in spans if s[0] < last and s[1] > first]
            for what, spans in piece.provenance.get(FILLED, {}).items()
        }
        told = piece.provenance | {FILLED: {k: v for k, v in filled.items() if v}}
        if use.left_out:
            told["objects_left_out"] = use.left_out
        return replace(piece, hand_object=slots, provenance=told)


def _remarks(
    demo: HumanDemo, windows: list[tuple[int, int]], pieces: list[HumanDemo]
) -> list[Finding]:
    if not pieces:
        text = f"no hand touches an object for {TOUCH_SECONDS} s in a stretch of "
        return [reject("R_INACTIVE", f"{text}{MIN_SECONDS} s")]
    idle = demo.seconds - sum(b - a for a, b in windows) / demo.fps
    used = sum(p.seconds for p in pieces)
    lost = max(demo.seconds - idle - used, 0.0)
    text = f"{len(pieces)} pieces of {used:.1f} s in all; {idle:.1f} s inactive, "
    found = [info("R_INACTIVE", f"{text}{lost:.1f} s too short or not tracked")]
    for piece in pieces:
        names = piece.provenance.get("objects_left_out")
        if names:
            text = f"{piece.name}: without {', '.join(names)}"
            first = piece.provenance["frames"][0]
            found.append(info("I_OBJECTS", text, (first,)))
    return found
