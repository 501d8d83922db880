"""A motion library made of formulas, in a fraction of a second, for env and training.

Three motions: the right hand with a box, the left hand with a ball, both hands with
both. The fingers close on the objects, so that there are contacts from early on.
"""

from __future__ import annotations

import contextlib
import json

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.hands.kinematics import HandKinematics
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_check import hash_rows
from flashdex.motions.library_format import read_manifest
from flashdex.motions.library_writer import LibraryWriter, MotionRecord
from flashdex.motions.velocities import derive_velocities
from flashdex.objects.asset import ObjectAsset
from flashdex.system.arrays import hash_content, write_array

# `world=friendly`: in the default one nothing of these converts at once
FRIENDLY = {"object_friction": 2.0, "support_friction": 1.0, "torsional_friction": 0.05}

FPS = 60.0
HALF = np.array([0.025, 0.03, 0.02])  # m, half extents of the box
BALL = 0.03  # m, radius
LENGTHS = {"right_box": 40, "left_ball": 31, "both": 52}
# Wrist hinges with the palm down, fingers half closed; left, right.
HINGES = np.array([[-0.4, 1.19, -0.13], [2.98, -1.19, 0.01]])
FINGERS = np.array([1.4, 0.5, 0.4, 0.1, 0.8, 0.6, 0.9, 0.6, 0.9, 0.6, 0.7, 1.0])


def write_library(path, hands, *, changes=None, manifest=None):
    """Write three motions of 40, 31 and 52 frames and open the library.

    ``changes`` holds functions by name of the motion; each changes its MotionRecord.
    """
    writer = LibraryWriter(path, hand="xhand", fps=FPS, manifest=manifest)
    box, ball = make_box(), make_ball()
    plans = {
        "right_box": ((False, True), (-1, 0), [box]),
        "left_ball": ((True, False), (0, -1), [ball]),
        "both": ((True, True), (1, 0), [box, ball]),
    }
    disks = np.full((4, 5), np.nan)
    disks[0] = [0.0, 0.0, 0.0, 0.8, 0.02]
    for name, (active, owner, objects) in plans.items():
        frames = make_frames(hands, LENGTHS[name], active, owner, objects)
        record = MotionRecord(name, frames, active, owner, objects, disks)
        for change in (changes or {}).get(name, ()):
            change(record)
        writer.add(record)
    return MotionLibrary.load(writer.write(report="motion\n"))


def make_frames(hands, length, active, owner, objects):
    """Every frame key of one motion, float64 numpy, from formulas."""
    time = np.arange(length) / FPS
    phase = np.arange(length) / (length - 1)
    lift = 0.06 * np.clip(phase - 0.5, 0, None)
    rest = [-o.aabb[0, 2] for o in objects]
    pos, quat = np.zeros((length, 2, 3)), np.zeros((length, 2, 4))
    quat[..., 0] = 1.0
    for slot in range(len(objects)):
        x = 0.15 * (1 - 2 * slot) if len(objects) == 2 else 0.02
        pos[:, slot] = np.stack([0 * lift + x, 0.1 * lift, rest[slot] + lift], -1)
        turn = Rotation.from_euler("z", (0.3 + 2.0 * lift)[:, None]).as_quat()
        quat[:, slot] = turn[:, [3, 0, 1, 2]]
    joints = np.zeros((length, 2, 18))
    for side in range(2):
        joints[:, side, 3:6] = HINGES[side] + 0.05 * np.sin(3 * time)[:, None]
        joints[:, side, 6:] = FINGERS * (0.9 + 0.15 * phase[:, None])
    centre = np.stack(
        [
            pos[:, max(0, s)] if on else pos[:, 0] + [-1.0, 0, 1.0]
            for s, on in zip(owner, active, strict=True)
        ],
        1,
    )
    kinematics = HandKinematics(hands)
    tips = kinematics(torch.as_tensor(joints).float(), None)["tip_pos"].double()
    joints[..., :3] = centre + np.array([0, 0, 0.008]) - tips.mean(2).numpy()
    kin = kinematics(torch.as_tensor(joints).float(), None)
    keypoints = human_hand(hands, kin, time)
    distance = np.linalg.norm(
        keypoints[:, :, [4, 8, 12, 16, 20]] - centre[:, :, None], axis=-1
    )
    frames = {
        "joint_pos": joints,
        "wrist_pos": keypoints[:, :, 0],
        "wrist_quat": kin["wrist_quat"].double().numpy(),
        "keypoints": keypoints,
        "tip_dist": np.clip(distance - 0.02, 0.0, None),
        "object_pos": pos,
        "object_quat": quat,
    }
    return frames | derive_velocities(frames, FPS)


def human_hand(hands, kin, time):
    """Keypoints near the robot's links, a few millimetres off."""
    points = kin["wrist_pos"].double().numpy()[:, :, None].repeat(21, 2)
    for side, name in enumerate(("left", "right")):
        for link, keypoint in hands[name].keypoint_links:
            points[:, side, keypoint] = kin["link_pos"][:, side, link].double().numpy()
    points[:, :, [4, 8, 12, 16, 20]] = kin["tip_pos"].double().numpy()
    offset = 0.004 * np.sin(np.arange(21) + 5 * time[:, None])
    return points + offset[:, None, :, None] * np.array([1.0, -0.5, 0.3])


def make_box():
    """A box whose centre of mass lies off its frame."""
    mass = 0.12
    square = (2 * HALF) ** 2
    inertia = np.diag(mass / 12 * (square.sum() - square))
    inertia[0, 1] = inertia[1, 0] = 4e-6
    mesh = trimesh.creation.box(extents=2 * HALF)
    grid = np.random.default_rng(0).uniform(-1, 1, (128, 3))
    grid[np.arange(128), np.arange(128) % 3] = np.sign(grid[np.arange(128), 0])
    points = grid * HALF

    def distance(p):
        gap = np.abs(p) - HALF
        outside = np.linalg.norm(np.clip(gap, 0, None), axis=-1)
        return outside + np.clip(gap.max(-1), None, 0)

    com = np.array([0.003, -0.002, 0.001])
    return make_asset("box", mesh, points, distance, mass, com, inertia)


def make_ball():
    """A ball, centred."""
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=BALL)
    draw = np.random.default_rng(1).normal(size=(128, 3))
    points = BALL * draw / np.linalg.norm(draw, axis=-1, keepdims=True)
    mass = 0.09
    inertia = np.eye(3) * 0.4 * mass * BALL**2

    def distance(p):
        return np.linalg.norm(p, axis=-1) - BALL

    return make_asset("ball", mesh, points, distance, mass, np.zeros(3), inertia)


def make_asset(name, mesh, points, distance, mass, com, inertia):
    """An object from closed forms."""
    axis = np.linspace(-0.09, 0.09, 37)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return ObjectAsset(
        name=name,
        points=np.float32(points),
        normals=np.float32(points / np.linalg.norm(points, axis=-1, keepdims=True)),
        radius=float(np.linalg.norm(points, axis=-1).max()),
        parts=[np.float32(mesh.vertices)],
        sdf=np.float32(distance(nodes)),
        sdf_origin=np.float32([-0.09] * 3),
        sdf_spacing=float(axis[1] - axis[0]),
        mass=mass,
        com=np.float32(com),
        inertia=np.float32(inertia),
        aabb=np.float32(mesh.bounds),
        watertight=True,
        sha256=name,
        visual_vertices=np.float32(mesh.vertices),
        visual_faces=np.asarray(mesh.faces, np.int32),
    )


def forge_library(path, edit):
    """Change a library as somebody who knows the format: all hashes fit again.

    ``edit`` gets the manifest's entries and the arrays by name and changes them.
    """
    entries = json.loads((path / "manifest.json").read_text())
    data = path / entries["data"]
    arrays = {name: np.load(data / f"{name}.npy") for name in entries["arrays"]}
    edit(entries, arrays)
    for name, array in arrays.items():
        (data / f"{name}.npy").unlink(missing_ok=True)
        entries["arrays"][name] = write_array(data / f"{name}.npy", array).to_dict()
    for file in entries["meshes"]:
        if (data / file).is_file():
            entries["meshes"][file] = hash_content(data / file)
    with contextlib.suppress(Exception):  # of what is no library any more
        hashes = hash_rows(entries, arrays, entries["meshes"])
        for part, found in zip(("motions", "objects"), hashes, strict=True):
            for row, digest in zip(entries[part], found, strict=True):
                row["content_sha256"] = digest
    (path / "manifest.json").write_text(json.dumps(entries))


def renew_velocities(arrays):
    """Make the velocities follow from the positions again."""
    rows = zip(arrays["motions/start"], arrays["motions/length"], strict=True)
    for start, length in rows:
        span = slice(start, start + length)
        frames = {n[7:]: a[span] for n, a in arrays.items() if n.startswith("frames/")}
        for key, speed in derive_velocities(frames, FPS).items():
            arrays[f"frames/{key}"][span] = speed


def data_of(path):
    """Folder of the arrays and meshes of a library."""
    return path / read_manifest(path).data


def edit_manifest(path, edit):
    """Change entries of a manifest; no hash fits any more."""
    entries = json.loads((path / "manifest.json").read_text())
    edit(entries)
    (path / "manifest.json").write_text(json.dumps(entries))
