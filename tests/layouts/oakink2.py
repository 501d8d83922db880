"""Writes OakInk2 sequences: quaternions about the flat hand, wrist in the world, y up.

Everything is a dict by mocap id; some quaternions have the other sign.
"""

from __future__ import annotations

import json
import pickle

import numpy as np
import torch

from layouts.taco import matrices

TOKEN = "scene_01__A001++0123456789abcdef0123__2023-04-27-19-17-39"
IDS = ("O02@0206@00001", "C12001")
FORMATS = ("ply", "obj")
PREFIX = {"left": "lh", "right": "rh"}
# from z up to y up: (x, y, z) -> (x, z, -y), a quarter turn back about x
TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
TURN = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])


def write(
    root,
    scene,
    *,
    token=TOKEN,
    first=0,
    program=None,
    release="object_repair",
    missing=(),
    objects_missing=(),
):
    """Write one sequence and its meshes.

    Args:
        root: of the dataset.
        scene: at 120 fps, both hands, two objects.
        token: name of the sequence.
        first: mocap id of the first frame.
        program: primitives by their keys; None for no program.
        release: folder of the meshes.
        missing: frames that are not in the list of ids.
        objects_missing: frames in which the first object has no transform.
    """
    frames = [i for i in range(len(scene.times)) if i not in missing]
    transforms = {}
    for place, (name, body) in enumerate(zip(IDS, scene.objects, strict=True)):
        track = matrices(body.pose)
        track[:, :3] = TO_Y_UP @ track[:, :3]
        gone = objects_missing if place == 0 else ()
        transforms[name] = {i + first: track[i] for i in frames if i not in gone}
        folder = root / release / "align_ds" / name
        folder.mkdir(parents=True, exist_ok=True)
        body.mesh.export(folder / f"scan.{FORMATS[place]}")
    hands = {side: parameters(hand) for side, hand in scene.hands.items()}
    raw = {}
    for i in frames:
        raw[i + first] = {
            f"{PREFIX[side]}__{key}": torch.tensor(track[i][None], dtype=torch.float32)
            for side, tracks in hands.items()
            for key, track in tracks.items()
        }
    annotation = {
        "mocap_frame_id_list": [i + first for i in frames],
        "frame_id_list": [i + first for i in frames[::4]],
        "obj_list": list(IDS),
        "obj_transf": transforms,
        "raw_mano": raw,
        "cam_def": {},
    }
    dump(root, annotation, token=token)
    if program is not None:
        folder = root / "program" / "program_info"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{token}.json").write_text(json.dumps(program))
    return root


def dump(root, annotation, *, token=TOKEN):
    """Write an annotation."""
    file = root / "anno_preview" / f"{token}.pkl"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(pickle.dumps(annotation))


def primitive(name, left, right, *, every=None):
    """One item of a program: its name and the objects of each hand."""
    return {
        "primitive": name,
        "obj_list": list(dict.fromkeys([*left, *right])) if every is None else every,
        "interaction_mode": "bh_main" if left and right else "rh_main",
        "primitive_lh": name if left else None,
        "primitive_rh": name if right else None,
        "obj_list_lh": left,
        "obj_list_rh": right,
    }


def parameters(hand):
    """Quaternions (T, 16, 4), wrist (T, 3) and shape (T, 10) of a hand, y up."""
    vectors = hand.axis_angle.reshape(-1, 16, 3)
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = vectors / np.where(angle > 0, angle, 1.0)
    quats = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=-1)
    quats[:, 0] = product(TURN, quats[:, 0])
    quats[::3] *= -1
    quats[:, 5:9] *= -1
    wrist = hand.wrist @ TO_Y_UP.T
    betas = np.repeat(hand.betas[None], len(wrist), axis=0)
    return {"pose_coeffs": quats, "tsl": wrist, "betas": betas}


def product(first, second):
    """Quaternion product, wxyz, of one with many (T, 4)."""
    w, v = first[0], first[1:]
    s, u = second[:, :1], second[:, 1:]
    real = w * s - (u @ v)[:, None]
    return np.concatenate([real, w * u + s * v + np.cross(v, u)], axis=1)
