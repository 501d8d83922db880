"""Writes TACO sequences: axis-angle 48 about the flat hand, wrist in the world.

Meshes in centimetres, poses (T, 4, 4) in metres, hands as pickled torch tensors by
frame keys, in the wrong order.
"""

from __future__ import annotations

import pickle

import numpy as np
import torch
import trimesh

ROLES = ("tool", "target")
TRIPLET = "(pour in some, bowl, plate)"
SEQUENCE = "20231104_017"
IDS = ("003", "112")


def write(
    root,
    scene,
    *,
    triplet=TRIPLET,
    sequence=SEQUENCE,
    ids=IDS,
    dtype=np.float64,
    shapes=("left", "right"),
    frame_files=(),
    lengths=None,
    nan=None,
    models="Object_Models",
    key="{:05d}",
):
    """Write one sequence and its meshes.

    Args:
        root: of the dataset.
        scene: at 30 fps, both hands, two objects.
        triplet: name of the folder.
        sequence: name of the folder in it.
        ids: of the meshes of tool and target.
        dtype: of the poses.
        shapes: hands that get a shape file.
        frame_files: hands in the older layout, one file a frame.
        lengths: frames of a track, where they are not all: left, right, tool, target.
        nan: frames without numbers, by track.
        models: folder of the meshes.
        key: format of the frame keys; the first frame is 1.
    """
    lengths, nan = lengths or {}, nan or {}
    hands = root / "Hand_Poses" / triplet / sequence
    hands.mkdir(parents=True)
    for side, hand in scene.hands.items():
        table = np.concatenate([hand.axis_angle, hand.wrist], axis=1)
        table = table[: lengths.get(side)]
        table[nan.get(side, [])] = np.nan
        frames = {key.format(i + 1): frame(row) for i, row in enumerate(table)}
        if side in frame_files:
            (hands / f"{side}_hand").mkdir()
            for name, content in frames.items():
                dump(hands / f"{side}_hand" / f"hand_{name}.pkl", content)
        else:
            dump(hands / f"{side}_hand.pkl", dict(reversed(frames.items())))
        if side in shapes:
            shape = {"hand_shape": torch.nn.Parameter(torch.tensor(hand.betas)[None])}
            dump(hands / f"{side}_hand_shape.pkl", shape)
    poses = root / "Object_Poses" / triplet / sequence
    poses.mkdir(parents=True)
    (root / models).mkdir(parents=True, exist_ok=True)
    for role, name, body in zip(ROLES, ids, scene.objects, strict=True):
        track = matrices(body.pose)[: lengths.get(role)].astype(dtype)
        track[nan.get(role, [])] = np.nan
        np.save(poses / f"{role}_{name}.npy", track)
        large = trimesh.Trimesh(body.mesh.vertices * 100, body.mesh.faces)
        large.export(root / models / f"{name}_cm.obj")
    return root


def frame(row):
    """One frame: parameters that still want a gradient."""
    row = torch.tensor(row, dtype=torch.float32)
    return {
        "hand_pose": torch.nn.Parameter(row[:48]),
        "hand_trans": torch.nn.Parameter(row[48:]),
    }


def dump(file, content):
    """Pickle it, as the dataset does."""
    file.write_bytes(pickle.dumps(content))


def matrices(pose):
    """(T, 4, 4) of positions and quaternions wxyz (T, 7)."""
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
    out[:, :3, 3] = pose[:, :3]
    out[:, 3, 3] = 1.0
    return out
