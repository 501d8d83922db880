"""Writes HOT3D sequences, Aria (doubled stamps, z up) or Quest (y up), with models."""

from __future__ import annotations

import json

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from layouts.reference_fk import rodrigues
from layouts.umetrack import UMETRACK_SHIFT, joint_angles, profile

START = 43_124_400_000_000  # ns
SECOND_STAMP = 90_813  # ns after the first, Aria
IDS = {"left": "0", "right": "1"}
STREAMS = {"Aria": ("214-1", "1201-1", "1201-2"), "Quest3": ("1201-1", "1201-2")}
POSE_HEADER = (
    "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
)
FIRST_UID = 100_000_000_000_001
NO_MODEL_UID = 999_000_000_000_009  # "coffee_pot": moves most, has no .glb
HEADSET_UID = 58_635_154_735_610
# from z up to y up: (x, y, z) -> (x, z, -y)
TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def write(
    root,
    scene,
    *,
    name="P0003_c701bd11",
    headset="Quest3",
    participant="P0003",
    metadata="status",
    truth=True,
    masks=("object_pose_available", "hand_pose_available", "object_pose_quality"),
    forbidden=None,
    holes=(),
    no_left=(),
    no_hands=(),
    coffee_pot=False,
    models=True,
    omit=(),
):
    """Write one sequence into ``root`` and the library beside it.

    Args:
        root: gets ``<name>/`` and ``object_library/``.
        scene: the motion, 30 fps.
        name: of the sequence.
        headset: Aria or Quest3.
        participant: of the metadata.
        metadata: "status" or "flag", the two layouts.
        truth: what the metadata says of the ground truth.
        masks: to write.
        forbidden: per mask, {frame: streams that are False}.
        holes: frames that no file has.
        no_left: frames without the left hand.
        no_hands: frames without a line in the hand files.
        coffee_pot: add an object without a model that moves most.
        models: write the .glb files.
        omit: file names to leave out.

    Returns:
        The folder of the sequence.
    """
    folder = root / name
    (folder / "masks").mkdir(parents=True)
    turn = TO_Y_UP if headset == "Quest3" else np.eye(3)
    stamps = [s for s in _stamps(scene, headset) if s[0] not in holes]
    texts = {
        "dynamic_objects.csv": _object_rows(scene, stamps, turn, coffee_pot),
        "headset_trajectory.csv": _headset_rows(scene, stamps, turn),
        "metadata.json": _metadata(scene, headset, participant, metadata, truth, name),
        "umetrack_hand_user_profile.json": json.dumps({"hand_model": profile()}),
    }
    for kind, pose in {"mano": _mano_hand, "umetrack": _umetrack_hand}.items():
        file = f"{kind}_hand_pose_trajectory.jsonl"
        texts[file] = _hand_lines(scene, stamps, turn, pose, no_left, no_hands)
    for mask in masks:
        refused = (forbidden or {}).get(mask, {})
        texts[f"masks/mask_{mask}.csv"] = _mask_rows(stamps, headset, refused)
    for file, text in texts.items():
        if file not in omit:
            (folder / file).write_text(text)
    _write_library(root / "object_library", scene, models, coffee_pot)
    return folder


def _stamps(scene, headset):
    """(frame, stamp, is the first stamp of its frame) of the recording."""
    rows = []
    for frame in range(len(scene.times)):
        stamp = START + round(frame * 1e9 / 30)
        rows.append((frame, stamp, True))
        if headset == "Aria":
            rows.append((frame, stamp + SECOND_STAMP, False))
    return rows


def _pose_row(uid, stamp, place, turn):
    quat = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return ",".join([str(uid), str(stamp), *(f"{v:.9f}" for v in [*place, *quat])])


def _object_rows(scene, stamps, turn, coffee_pot):
    rows = [POSE_HEADER]
    for frame, stamp, first in stamps:
        # a reader that takes the wrong one of two stamps is 2 mm off
        late = np.zeros(3) if first else np.array([0.002, 0, 0])
        for slot, body in enumerate(scene.objects):
            pose = body.pose[frame]
            matrix = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
            place = turn @ (pose[:3] + late)
            rows.append(_pose_row(FIRST_UID + slot, stamp, place, turn @ matrix))
        if coffee_pot:
            place = np.array([0.3 + 0.02 * frame, 0.3, scene.table_z])
            rows.append(_pose_row(NO_MODEL_UID, stamp, turn @ place, turn))
    return "\n".join(rows) + "\n"


def _headset_rows(scene, stamps, turn):
    place = turn @ np.array([0.0, -0.3, scene.table_z + 0.45])
    rows = [_pose_row(HEADSET_UID, stamp, place, turn) for _, stamp, _ in stamps]
    return "\n".join([POSE_HEADER, *rows]) + "\n"


def _wrist(place, matrix):
    quat = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    return {"t_xyz": _short(place), "q_wxyz": _short(quat)}


def _mano_hand(scene, side, frame, turn):
    hand = scene.hands[side]
    # the root turns about J0: only the wrist moves with the world, J0 does not
    place = turn @ hand.wrist[frame] - hand.j0
    return {
        "pose": _short(hand.coefficients[frame]),
        "wrist_xform": _wrist(place, turn @ hand.rotations[frame, 0]),
        "betas": _short(hand.betas),
    }


def _umetrack_hand(scene, side, frame, turn):
    hand = scene.hands[side]
    place = turn @ (hand.wrist[frame] + UMETRACK_SHIFT)
    return {
        "wrist_xform": _wrist(place, turn @ hand.rotations[frame, 0]),
        "joint_angles": _short(joint_angles(frame)),
        "hand_confidence": 1.0,
    }


def _short(values):
    return [round(float(v), 8) for v in values]


def _hand_lines(scene, stamps, turn, pose, no_left, no_hands):
    lines = []
    for frame, stamp, first in stamps:
        if frame in no_hands:
            continue
        hands = {
            IDS[side]: pose(scene, side, frame, turn)
            for side in scene.hands
            if not (side == "left" and frame in no_left)
        }
        for hand in hands.values():
            if not first:
                hand["wrist_xform"]["t_xyz"][0] += 0.002
        lines.append(json.dumps({"timestamp_ns": stamp, "hand_poses": hands}))
    return "\n".join(lines) + "\n"


def _mask_rows(stamps, headset, refused):
    rows = ["timestamp[ns],stream_id,mask"]
    for frame, stamp, first in stamps:
        streams = STREAMS[headset]
        if headset == "Aria":
            streams = streams[:1] if first else streams[1:]
        off = refused.get(frame, ())
        rows += [f"{stamp},{stream},{stream not in off}" for stream in streams]
    return "\n".join(rows) + "\n"


def _metadata(scene, headset, participant, layout, truth, name):
    data = {"headset": headset, "participant_id": participant, "recording_name": name}
    if layout == "status":
        kinds = ("mano_hand_pose_gt", "umetrack_hand_pose_gt", "object_pose_gt")
        return json.dumps({"gt_available_status": dict.fromkeys(kinds, truth)} | data)
    data["have_hand_object_pose_gt"] = truth
    data["object_uids"] = [str(FIRST_UID + i) for i in range(len(scene.objects))]
    data["object_names"] = [body.name for body in scene.objects]
    return json.dumps(data | {"dataset_version": "v2"})


def _write_library(folder, scene, models, coffee_pot):
    folder.mkdir(exist_ok=True)
    names = {str(FIRST_UID + i): body.name for i, body in enumerate(scene.objects)}
    if coffee_pot:
        names[str(NO_MODEL_UID)] = "coffee_pot"
    text = {u: {"instance_id": u, "instance_name": n} for u, n in names.items()}
    (folder / "instance.json").write_text(json.dumps(text))
    for slot, body in enumerate(scene.objects):
        if models:
            data = _glb(body.mesh, open_face=slot == 0)
            (folder / f"{FIRST_UID + slot}.glb").write_bytes(data)


def _glb(mesh, *, open_face):
    """The mesh in mm under a node that scales, turns and shifts it; one face lost."""
    node = np.eye(4)
    matrix = rodrigues(np.array([0.4, -1.1, 0.7]))
    node[:3, :3], node[:3, 3] = 1e-3 * matrix, [0.0046, -0.0207, -0.0156]
    vertices = (np.asarray(mesh.vertices) - node[:3, 3]) @ matrix * 1e3
    faces = mesh.faces[1:] if open_face else mesh.faces
    scene = trimesh.Scene()
    raw = trimesh.Trimesh(vertices, faces, process=False)
    scene.add_geometry(raw, node_name="node", transform=node)
    return scene.export(file_type="glb")
