"""One clip of FlashDexRetarget, as arrays by name, becomes a motion.

The joints are those of MANO: the thumb's proximal, intermediate and distal joints are
its CMC, MCP and IP, the other fingers' are MCP, PIP and DIP.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fdr.scene import context_objects, support_height
from flashdex.datasets.fields import number, numbers, poses_from_matrices, word
from flashdex.datasets.roots import find_mesh, scaled_mesh, seek_mesh
from flashdex.datasets.tracks import rotation
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
    return (
        body.name == name
        and body.pose.shape == pose.shape
        and np.allclose(body.pose, pose, atol=1e-5, equal_nan=True)
    )
