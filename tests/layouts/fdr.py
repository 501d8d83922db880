"""Writes FlashDexRetarget's ``human_demo/<clip>.npz``, ``objects/``, ``motion.pt``."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from layouts.reference_fk import rodrigues

# place in the 21 keypoints of a finger's proximal joint; four keypoints a finger
FIRST = {"thumb": 1, "index": 5, "middle": 9, "ring": 13, "pinky": 17}
STEPS = {"proximal": 0, "intermediate": 1, "distal": 2, "tip": 3}
REBASE = {
    "right": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "left": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


def write(root, scene, *, name="clip_a", shared=False, folder="human_demo", **changes):
    """One clip and its meshes; ``changes`` replace entries, None leaves one out."""
    clip = make_clip(scene, shared=shared) | changes
    clip = {key: value for key, value in clip.items() if value is not None}
    (root / folder).mkdir(parents=True, exist_ok=True)
    np.savez(root / folder / f"{name}.npz", **clip)
    write_meshes(root / "objects", scene)
    return root


def write_meshes(folder, scene):
    """``<id>/visual.obj``, and the convex parts that the reader must leave alone."""
    for body in scene.objects:
        (folder / body.name / "convex").mkdir(parents=True, exist_ok=True)
        body.mesh.export(folder / body.name / "visual.obj")
        body.mesh.convex_hull.export(folder / body.name / "convex" / "part_0.obj")


def make_clip(scene, *, shared=False):
    """The arrays of one clip."""
    clip = {"fps": np.float32(scene.fps)}
    for side, hand in scene.hands.items():
        names = sorted(f"{finger}_{step}" for finger in FIRST for step in STEPS)
        places = [FIRST[n.split("_")[0]] + STEPS[n.split("_")[1]] for n in names]
        joints = np.stack([hand.keypoints[:, p] for p in places], axis=1)
        root = np.array([rodrigues(v) for v in hand.axis_angle[:, :3]])
        clip[f"mano_{side}_joints"] = joints
        clip[f"mano_{side}_wrist_pos"] = hand.wrist
        clip[f"mano_{side}_wrist_rot"] = root @ REBASE[side]
        body = scene.objects[0 if shared or side == "right" else 1]
        clip[f"obj_{side}_pose"] = matrices(body.pose)
        clip[f"obj_{side}_id"] = np.array(body.name)
    return clip


def matrices(pose):
    """Poses (T, 7), wxyz, as transforms (T, 4, 4)."""
    w, x, y, z = pose[:, 3:].T
    out = np.zeros((len(pose), 4, 4))
    out[:, 0, :3] = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1
    )
    out[:, 1, :3] = np.stack(
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1
    )
    out[:, 2, :3] = np.stack(
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
    )
    out[:, :3, 3], out[:, 3, 3] = pose[:, :3], 1.0
    return out


def write_pack(root, scenes, *, fps=60.0, **changes):
    """``motion.pt`` of several scenes, one clip each, and the meshes."""
    root.mkdir(parents=True, exist_ok=True)
    clips = [make_clip(scene) for scene in scenes]
    lengths = torch.tensor([len(scene.times) for scene in scenes])
    pack = {
        "motion_num_frames": lengths,
        "length_starts": torch.cumsum(lengths, 0) - lengths,
        "motion_filename": [f"clip_{i}" for i in range(len(scenes))],
    }
    for side in ("right", "left"):
        # the second slot is unused: a slot is not a clip
        name = scenes[0].objects[0 if side == "right" else 1].name
        pack[f"{side}_object_mesh_dirs"] = ["objects/none", f"objects/{name}"]
        pack[f"{side}_object_mesh_scales"] = [2.0, 1.0]
        pack[f"motion_object_slot_{side}"] = torch.ones(len(scenes), dtype=torch.long)
        pack[f"mano_{side}_joint_names"] = sorted(
            f"{f}_{s}" for f in FIRST for s in STEPS
        )
        for key in ("joints", "wrist_pos", "wrist_rot"):
            pack[f"mano_{side}_{key}"] = _flat([c[f"mano_{side}_{key}"] for c in clips])
        poses = [c[f"obj_{side}_pose"] for c in clips]
        pack[f"obj_{side}_pos"] = _flat([p[:, :3, 3] for p in poses])
        pack[f"obj_{side}_rotmat"] = _flat([p[:, :3, :3] for p in poses])
        speeds = [_speed(c[f"mano_{side}_wrist_pos"], fps) for c in clips]
        pack[f"mano_{side}_wrist_vel"] = _flat(speeds)
    pack = {k: v for k, v in (pack | changes).items() if v is not None}
    torch.save(pack, root / "motion.pt")
    write_meshes(root / "objects", scenes[0])
    return root


def _flat(tracks):
    return torch.from_numpy(np.concatenate(tracks).astype(np.float32))


def _speed(track, fps):
    steps = np.gradient(track, axis=0) * fps
    return gaussian_filter1d(steps, 2.0, axis=0, mode="nearest")
