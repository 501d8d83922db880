"""Writes ARCTIC sequences: object arrays, millimetres, a hinged object."""

from __future__ import annotations

import json

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from layouts.mano_files import mano_hand
from layouts.reference_fk import rodrigues

# the object frame lies on its side: the hinge about its z is level, as of a lid
SIDEWAYS = rodrigues(np.array([np.pi / 2, 0.0, 0.0]))


def opening(scene):
    """Angle of the made-up hinge, rad, (T,)."""
    return 0.4 + 0.8 * np.sin(scene.times)


def halves(scene):
    """The box of the scene cut at its middle: top and bottom, m, object frame."""
    size = scene.objects[0].mesh.extents / [1, 1, 2]
    parts = {}
    for name, sign in (("top", 1), ("bottom", -1)):
        parts[name] = trimesh.creation.box(size)
        parts[name].apply_translation([0, 0, sign * size[2] / 2])
        parts[name].vertices = parts[name].vertices @ SIDEWAYS
    return parts


def expected_vertices(scene, name, frame):
    """World vertices of a part, by the plain formula."""
    pose = scene.objects[0].pose[frame]
    vertices = halves(scene)[name].vertices
    if name == "top":
        turn = rodrigues(np.array([0.0, 0.0, -1.0]) * opening(scene)[frame])
        vertices = vertices @ turn.T
    return vertices @ (rodrigues(rotvec(pose[3:])) @ SIDEWAYS).T + pose[:3]


def rotvec(quat):
    """Axis-angle of one quaternion wxyz."""
    sine = np.linalg.norm(quat[1:])
    axis = quat[1:] / sine if sine > 1e-9 else np.array([0.0, 0, 1])
    return axis * 2 * np.arctan2(sine, quat[0])


def write(root, scene, *, name="s01/box_use_01", hand=None, obj=None, split=None):
    """One sequence and its templates.

    Args:
        root: of the dataset.
        scene: what is written; object 0 becomes the hinged box.
        name: of the sequence.
        hand: replaces entries of the right hand; None leaves one out.
        obj: called on the object's array.
        split: of the sequence, in the dataset's protocol.
    """
    folder = root / "raw_seqs" / name.split("/")[0]
    folder.mkdir(parents=True, exist_ok=True)
    hands = {}
    for side, moved in scene.hands.items():
        model = mano_hand(side)
        hands[side] = {
            "rot": moved.axis_angle[:, :3],
            "pose": moved.axis_angle[:, 3:] - model.hands_mean,
            "trans": moved.wrist - moved.j0,
            "shape": moved.betas,
            "fitting_err": np.zeros(len(scene.times)),
        }
    hands["right"] = {
        k: v for k, v in (hands["right"] | (hand or {})).items() if v is not None
    }
    np.save(root / "raw_seqs" / f"{name}.mano.npy", np.array(hands, dtype=object))
    pose = scene.objects[0].pose
    stored = np.zeros((len(pose), 7))
    stored[:, 0] = opening(scene)
    turns = [rodrigues(rotvec(q)) @ SIDEWAYS for q in pose[:, 3:]]
    stored[:, 1:4] = Rotation.from_matrix(turns).as_rotvec()
    stored[:, 4:] = 1000 * pose[:, :3]
    stored = stored if obj is None else obj(stored)
    np.save(root / "raw_seqs" / f"{name}.object.npy", stored)
    meshes = root / "meta" / "object_vtemplates" / "box"
    meshes.mkdir(parents=True, exist_ok=True)
    for part, mesh in halves(scene).items():
        mesh.apply_scale(1000).export(meshes / f"{part}.obj")
    if split:
        (root / "splits_json").mkdir(exist_ok=True)
        text = json.dumps({"train": [], "val": [], split: [name]})
        (root / "splits_json" / "protocol_p1.json").write_text(text)
    return root
