"""Writes SPIDER's ``processed/<dataset>/mano/<embodiment>/<task>/<id>/`` folders."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

TIPS = [4, 8, 12, 16, 20]


def write(
    root,
    scene,
    *,
    task="lift_box",
    embodiment="bimanual",
    turn=None,
    shift=None,
    info=None,
    info_beside=False,
    **changes,
):
    """One reference, its info and its meshes.

    Args:
        root: SPIDER's dataset folder.
        scene: what is written.
        task: folder of the task.
        embodiment: bimanual, left or right.
        turn: rotates the axes of the wrist frame, (3, 3).
        shift: moves the stored wrist, m, (3,).
        info: replaces entries of ``task_info.json``; None writes them all.
        info_beside: put the info beside the arrays, not one folder up.
        changes: replace arrays; None leaves one out.
    """
    folder = root / "processed" / "made_up" / "mano" / embodiment / task / "0"
    folder.mkdir(parents=True, exist_ok=True)
    arrays = make_arrays(scene, embodiment, turn, shift) | changes
    arrays = {key: value for key, value in arrays.items() if value is not None}
    np.savez(folder / "trajectory_keypoints.npz", **arrays)
    told = {"task": task, "embodiment_type": embodiment, "ref_dt": 1 / scene.fps}
    for side, body in zip(("right", "left"), scene.objects, strict=False):
        mesh = root / "processed" / "made_up" / "assets" / "objects" / body.name
        (mesh / "convex").mkdir(parents=True, exist_ok=True)
        body.mesh.export(mesh / "visual.obj")
        body.mesh.convex_hull.export(mesh / "convex" / "0.obj")
        used = embodiment in (side, "bimanual")
        told[f"{side}_object_mesh_dir"] = str(mesh.relative_to(root)) if used else None
    place = folder if info_beside else folder.parent
    told = {k: v for k, v in (told | (info or {})).items() if v != "left out"}
    (place / "task_info.json").write_text(json.dumps(told))
    return root


def make_arrays(scene, embodiment, turn, shift):
    """Wrist frame: z to the middle knuckle, x out of the palm, y to the index side."""
    frames, arrays = len(scene.times), {}
    for slot, side in enumerate(("right", "left")):
        wrist = np.tile([0.0, 0, 0, 1, 0, 0, 0], (frames, 1))
        tips = np.tile([0.0, 0, 0, 1, 0, 0, 0], (frames, 5, 1))
        body = wrist.copy()
        if side in scene.hands and embodiment in (side, "bimanual"):
            points = scene.hands[side].keypoints
            ahead = points[:, 9] - points[:, 0]
            ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
            across = points[:, 5] - points[:, 13]
            out = np.cross(across if side == "right" else -across, ahead)
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            axes = np.stack([out, np.cross(ahead, out), ahead], axis=-1)
            axes = axes if turn is None else axes @ turn
            wrist[:, :3] = points[:, 0] + (0 if shift is None else shift)
            wrist[:, 3:] = Rotation.from_matrix(axes).as_quat(scalar_first=True)
            tips[..., :3] = points[:, TIPS]
            if slot < len(scene.objects):
                body = scene.objects[slot].pose
        arrays[f"qpos_wrist_{side}"] = wrist
        arrays[f"qpos_finger_{side}"] = tips
        arrays[f"qpos_obj_{side}"] = body
    return arrays
