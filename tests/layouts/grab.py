"""Writes GRAB sequences: nested tables in 0-d object arrays, transposed rotations."""

from __future__ import annotations

import numpy as np
import trimesh

from layouts.arctic import rotvec
from layouts.mano_files import mano_hand
from layouts.reference_fk import shaped

TABLE_THICKNESS = 0.03
TABLE_TURN = np.array([0.0, 0.0, 0.7])  # rad; it must not tilt the top
MESHES = "tools/object_meshes/contact_meshes"


def write(
    root,
    scene,
    *,
    name="s1/mug_drink_1",
    hand=None,
    left_out=(),
    coefficients=False,
    **changes,
):
    """One sequence, the subject's hands and the meshes.

    Args:
        root: of the dataset.
        scene: what is written; object 0 is the one that is grasped.
        name: of the sequence.
        hand: replaces entries of the right hand's ``params``; None leaves one out.
        left_out: meshes that are not written.
        coefficients: leave ``fullpose`` out, so that only ``hand_pose`` is there.
        changes: replace entries of the file; None leaves one out.
    """
    subject, stem = name.split("/")
    (root / "grab" / subject).mkdir(parents=True, exist_ok=True)
    body, frames = scene.objects[0], len(scene.times)
    entries = {
        "gender": "male",
        "sbj_id": subject,
        "obj_name": stem.split("_")[0],
        "motion_intent": "drink",
        "framerate": float(scene.fps),
        "n_frames": frames,
        "n_comps": 45 if coefficients else 24,
        "object": {
            "params": {
                "global_orient": np.array([-rotvec(q) for q in body.pose[:, 3:]]),
                "transl": body.pose[:, :3],
            },
            "object_mesh": f"{MESHES}/{stem.split('_')[0]}.ply",
        },
        "table": {
            "params": {
                "global_orient": np.tile(TABLE_TURN, (frames, 1)),
                "transl": np.tile([0.3, 0.0, scene.table_z - 0.01], (frames, 1)),
            },
            "table_mesh": f"{MESHES}/table.ply",
        },
    }
    for side, moved in scene.hands.items():
        entries[f"{side[0]}hand"] = _hand(side, subject, moved, coefficients)
    params = entries["rhand"]["params"] | (hand or {})
    entries["rhand"]["params"] = {k: v for k, v in params.items() if v is not None}
    entries = {k: v for k, v in (entries | changes).items() if v is not None}
    arrays = {key: np.array(value, dtype=object) for key, value in entries.items()}
    np.savez(root / "grab" / subject / f"{stem}.npz", **arrays)
    _write_meshes(root, scene, subject, stem.split("_")[0], left_out)
    return root


def _hand(side, subject, moved, coefficients):
    fingers, model = moved.axis_angle[:, 3:], mano_hand(side)
    wide = fingers @ model.hands_components.T  # orthonormal rows
    params = {
        "global_orient": moved.axis_angle[:, :3],
        "hand_pose": wide if coefficients else wide[:, :24],
        "transl": moved.wrist - moved.j0,
        "fullpose": fingers,
    }
    if coefficients:
        del params["fullpose"]
    vtemp = f"tools/subject_meshes/male/{subject}_{side[0]}hand.ply"
    return {"params": params, "vtemp": vtemp}


def _write_meshes(root, scene, subject, name, left_out):
    folder, people = root / MESHES, root / "tools" / "subject_meshes" / "male"
    folder.mkdir(parents=True, exist_ok=True)
    people.mkdir(parents=True, exist_ok=True)
    table = trimesh.creation.box([0.8, 0.6, TABLE_THICKNESS])
    table.apply_translation([0, 0, 0.01 - TABLE_THICKNESS / 2])  # top at z = 0.01
    meshes = {
        folder / f"{name}.ply": scene.objects[0].mesh,
        folder / "table.ply": table,
    }
    for side, moved in scene.hands.items():
        vertices = shaped(mano_hand(side), moved.betas)
        faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
        hand = trimesh.Trimesh(vertices, faces, process=False)
        meshes[people / f"{subject}_{side[0]}hand.ply"] = hand
    for file, mesh in meshes.items():
        if file.name not in left_out:
            mesh.export(file)
