"""One clip of FlashDexRetarget, as arrays by name, becomes a motion.

The joints are those of MANO: the thumb's proximal, intermediate and distal joints are
its CMC, MCP and IP, the other fingers' are MCP, PIP and DIP.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fields import number, numbers, poses_from_matrices, word, words
from flashdex.datasets.roots import find_mesh, scaled_mesh, seek_mesh
from flashdex.datasets.tracks import rotation, same_track
from flashdex.errors import DemoError
from flashdex.keys import FINGERS, SIDES, Side

LICENCE = (
    "that of the recordings the clips were made from: TACO CC BY 4.0, OakInk2 see its "
    "dataset card, HOT3D its own agreement"
)
LEVELS = ("proximal", "intermediate", "distal", "tip")  # of a finger, from the palm
CHAINS = tuple(f"{finger}_{level}" for finger in FINGERS for level in LEVELS)
JOINT_NAMES = tuple(sorted(CHAINS))
# FDR's wrist axes are x to the middle finger, z out of the back of the hand; seen from
# it, the palm frame is turned by half a turn about x, on both sides (method.md 14).
PALM_IN_WRIST = np.diag([1.0, -1.0, -1.0])


def make_demo(
    clip: dict[str, Any], file: Path, name: str, folders: tuple[Path, ...]
) -> HumanDemo:
    """A clip's arrays as a motion."""
    hands: list[Side] = [s for s in SIDES if f"mano_{s}_joints" in clip]
    if not hands:
        raise DemoError(
            f"{file}: no hand. Expected mano_left_joints or mano_right_joints; found: "
            f"{', '.join(sorted(clip))}. Is this a clip of FlashDexRetarget?"
        )
    keypoints: dict[Side, np.ndarray] = {s: _keypoints(clip, s, file) for s in hands}
    bodies, hand_object, notes = _objects(clip, hands, file, folders)
    further, told = context_objects(clip, bodies, lambda o: seek_mesh(o, folders), file)
    height, decision = support_height(clip, [body.pose for body in bodies])
    demo = HumanDemo(
        name=name,
        fps=number(clip["fps"], what=f"{file}: fps"),
        keypoints=keypoints,
        objects=bodies + further,
        hand_object=hand_object,
        source="fdr",
        licence=LICENCE,
        support_z=height,
    )
    angles = {s: _wrist_angle(clip, s, demo.palm[s]) for s in hands}
    demo.provenance = {"support": decision, "wrist_to_palm_deg": angles} | notes | told
    return demo


def _keypoints(clip: dict[str, Any], side: Side, file: Path) -> np.ndarray:
    what = f"{file}: mano_{side}"
    joints = numbers(clip[f"mano_{side}_joints"], what=f"{what}_joints")
    wrist = numbers(clip.get(f"mano_{side}_wrist_pos", ()), what=f"{what}_wrist_pos")
    if joints.shape[1:] != (20, 3) or wrist.shape != (len(joints), 3):
        raise DemoError(
            f"{file}: mano_{side}_joints {joints.shape} and mano_{side}_wrist_pos "
            f"{wrist.shape}; expected (T, 20, 3) and (T, 3)."
        )
    names = [str(n) for n in clip.get(f"mano_{side}_joint_names", JOINT_NAMES)]
    if sorted(names) != list(JOINT_NAMES):
        raise DemoError(
            f"{file}: mano_{side}_joint_names are {', '.join(names)}; expected "
            f"{', '.join(JOINT_NAMES)} in any order."
        )
    chains = joints[:, [names.index(name) for name in CHAINS]]
    points = np.concatenate([wrist[:, None], chains], axis=1)
    points[~np.isfinite(points).all(axis=(1, 2))] = np.nan
    return points


def _wrist_angle(clip: dict[str, Any], side: Side, palm: np.ndarray) -> float | None:
    """Median angle of the stored wrist frame to the palm of the joints, degrees.

    Some ten degrees in sound clips; it is told, not judged.
    """
    stored = numbers(
        clip.get(f"mano_{side}_wrist_rot", ()), what=f"mano_{side}_wrist_rot"
    )
    if stored.shape != (len(palm), 3, 3):
        return None
    seen = np.isfinite(palm).all(-1) & np.isfinite(stored).all(axis=(1, 2))
    if not seen.any():
        return None
    own = rotation(palm[seen, 3:]).as_matrix()
    trace = np.einsum("tij,tij->t", stored[seen] @ PALM_IN_WRIST, own)
    angles = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return round(float(np.median(angles)), 1)


def _objects(
    clip: dict[str, Any], hands: list[Side], file: Path, folders: tuple[Path, ...]
) -> tuple[list[DemoObject], dict[Side, int], dict[str, Any]]:
    """The objects of the hands; one that both hold appears once."""
    bodies: list[DemoObject] = []
    used: dict[Side, int] = {}
    notes: dict[str, Any] = {}
    for side in hands:
        if f"obj_{side}_pose" not in clip or f"obj_{side}_id" not in clip:
            continue
        name = word(clip[f"obj_{side}_id"], what=f"{file}: obj_{side}_id")
        scale = number(
            clip.get(f"obj_{side}_scale", 1.0), what=f"{file}: obj_{side}_scale"
        )
        matrices = numbers(clip[f"obj_{side}_pose"], what=f"{file}: obj_{side}_pose")
        pose, repairs = poses_from_matrices(matrices, what=f"{file}: obj_{side}_pose")
        notes |= {f"obj_{side}_scale": scale} if scale != 1.0 else {}
        notes |= {f"obj_{side}_repairs": repairs} if repairs else {}
        mesh = scaled_mesh(find_mesh(name, folders, where=file), scale)
        twins = [i for i, b in enumerate(bodies) if _same(b, name, pose)]
        used[side] = twins[0] if twins else len(bodies)
        bodies += [] if twins else [DemoObject(name, mesh, pose)]
    if not bodies:
        raise DemoError(
            f"{file}: no object. Expected obj_left_pose and obj_left_id, or right; "
            f"found: {', '.join(sorted(clip))}."
        )
    return bodies, used, notes


def _same(body: DemoObject, name: str, pose: np.ndarray) -> bool:
    return body.name == name and same_track(body.pose, pose, atol=1e-5)


SAME_PLACE = 1e-3  # m; tracks of one object agree when they are closer


def support_height(
    clip: dict[str, Any], poses: list[np.ndarray]
) -> tuple[float | None, str]:
    """Height of the table from ``support_disks`` (K, 5): x, y, z_top, radius, height.

    The table is the lowest disc over which an object's origin starts or ends. Discs
    of radius 0 are padding. With no such disc the height (m) is left to be estimated.
    Poses of the objects, (T, 7). Also told is how it was decided.
    """
    if "support_disks" not in clip:
        return None, "no support_disks in the file: estimated from objects at rest"
    disks = numbers(clip["support_disks"], what="support_disks")
    if disks.size % 5:
        raise DemoError(f"support_disks has shape {disks.shape}; expected (K, 5).")
    disks = disks.reshape(-1, 5)
    tops = []
    for x, y, top, radius, _ in disks[np.isfinite(disks).all(-1) & (disks[:, 3] > 0)]:
        ends = np.concatenate([pose[[0, -1], :2] for pose in poses])
        if (np.hypot(*(ends - [x, y]).T) <= radius).any():
            tops.append(float(top))
    if not tops:
        return None, "no object starts or ends over a disc: estimated from rest"
    return min(tops), "lowest of support_disks over which an object starts or ends"


def context_objects(
    clip: dict[str, Any],
    held: list[DemoObject],
    seek: Callable[[str], Path | None],
    file: Path,
) -> tuple[list[DemoObject], dict[str, Any]]:
    """Objects of ``desk_context_*`` that no hand holds and whose mesh is found.

    Their tracks cover the whole recording that the clip was cut from; the clip's place
    in it is where its own object has the same track. Where this is not certain, the
    objects are left out. ``seek`` gives the mesh file of an object id, or None.
    """
    if "desk_context_ids" not in clip or "desk_context_poses" not in clip:
        return [], {}
    names = words(clip["desk_context_ids"])
    tracks = numbers(clip["desk_context_poses"], what=f"{file}: desk_context_poses")
    if len(tracks) != len(names):
        raise DemoError(
            f"{file}: desk_context_poses has {len(tracks)} tracks for {len(names)} ids."
        )
    scales = clip.get("desk_context_scales", np.ones(len(names)))
    scales = numbers(scales, what=f"{file}: desk_context_scales").ravel()
    if len(scales) != len(names):
        raise DemoError(f"{file}: {len(scales)} scales for {len(names)} context ids.")
    start = _place(dict(zip(names, tracks, strict=True)), held)
    others = [i for i, name in enumerate(names) if name not in {b.name for b in held}]
    if start is None:
        left_out = [names[i] for i in others]
        return [], {"desk_context": {"left_out": left_out, "why": "clip not located"}}
    bodies, left_out = [], []
    for i in others:
        mesh = seek(names[i])
        if mesh is None:
            left_out.append(names[i])
            continue
        part = tracks[i][start : start + len(held[0].pose)]
        pose, _ = poses_from_matrices(part, what=f"{file}: desk context {names[i]}")
        bodies.append(DemoObject(names[i], scaled_mesh(mesh, float(scales[i])), pose))
    told = {"first_frame": start, "no_mesh": left_out}
    return bodies, {"desk_context": told}


def _place(tracks: dict[str, np.ndarray], held: list[DemoObject]) -> int | None:
    """First frame of the clip in the recording; None where it is not certain."""
    frames = len(held[0].pose)
    lengths = {len(track) for track in tracks.values()}
    if lengths == {frames}:
        return 0
    known = [(tracks[b.name], b.pose) for b in held if b.name in tracks]
    if not known or min(lengths) < frames:
        return None
    places = []
    for start in range(min(lengths) - frames + 1):
        gaps = [t[start : start + frames, :3, 3] - p[:, :3] for t, p in known]
        if all(np.abs(gap).max() < SAME_PLACE for gap in gaps):
            places.append(start)
    return places[0] if len(places) == 1 else None
