"""A made-up UmeTrack profile: the stick hand of a left hand, in mm, and its keypoints.

``umetrack_keypoints`` walks the bones with 4x4 matrices, from joint to joint.
"""

from __future__ import annotations

import numpy as np

from layouts.reference_fk import rodrigues

UMETRACK_SHIFT = np.array([0.0006, -0.0004, 0.0005])  # of its wrist from MANO's, m
# mm, from the wrist: per finger the place of each hinge and the tip; a finger's first
# two hinges share a place, the thumb's have places of their own
THUMB = [[16, -9, 8], [46, -4, 23], [59, -27, 43], [82, -37, 66], [94, -43, 81]]
FINGERS = [
    [[97, -2, 23], [97, -2, 23], [134, -5, 22], [160, -7, 21], [180, -3, 18]],
    [[96, 3, 2], [96, 3, 2], [137, 0, -3], [165, -4, -6], [188, 0, -9]],
    [[89, -1, -17], [89, -1, -17], [126, -5, -27], [152, -8, -33], [175, -8, -38]],
    [[77, -8, -35], [77, -8, -35], [105, -12, -42], [124, -15, -48], [144, -15, -54]],
]
SPREAD, FLEX = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
CHAINS = [np.array(chain, dtype=float) for chain in (THUMB, *FINGERS)]
THUMB_AXES = [FLEX, np.array([0.0, 0.6, 0.8]), np.array([0.6, 0.8, 0.0])]
AXES = [[*THUMB_AXES, THUMB_AXES[2]]] + [[SPREAD, FLEX, FLEX, FLEX]] * 4


def umetrack_keypoints(scene, side):
    """What the UmeTrack files of a scene mean, (T, 21, 3), z up."""
    out = []
    for frame, hand in enumerate(scene.hands[side].rotations[:, 0]):
        local = [np.zeros(3)]
        angles = joint_angles(frame)
        for finger, (chain, axes) in enumerate(zip(CHAINS, AXES, strict=True)):
            places = _walk(chain, axes, angles[4 * finger : 4 * finger + 4])
            local += places[1:] if finger == 0 else [places[0], *places[2:]]
        points = np.array(local) * 1e-3
        if side == "right":
            points = points * [-1, 1, 1]
        place = scene.hands[side].wrist[frame] + UMETRACK_SHIFT
        out.append([place + hand @ point for point in points])
    return np.array(out)


def joint_angles(frame):
    """Angles of the 22 hinges, rad; the last two, of the wrist, stay zero."""
    angles = 0.3 + 0.2 * np.sin(0.2 * frame + np.arange(22))
    angles[20:] = 0.0
    return angles


def profile():
    """The hand model of the stick hand, mm, in the order of the real files."""
    rest = np.concatenate([*[chain[:4] for chain in CHAINS], np.zeros((2, 3))])
    tips = [chain[4] for chain in CHAINS]
    thumb, *fingers = CHAINS
    inner = [place for chain in fingers for place in chain[1:4]]
    marks = [*tips, np.zeros(3), *thumb[2:4], *inner, [80, -14, 4]]
    # bones: 2-4 the thumb's last three hinges, then three a finger, from 5 on
    frames = [
        255,
        2,
        3,
        4,
        *[f for i in range(4) for f in (255, *range(3 * i + 5, 3 * i + 8))],
    ]
    # a knuckle landmark sits on the hinge's axis, in the files it rides on bone 1
    bones = [4, 7, 10, 13, 16, 1, 2, 3]
    bones += [b for i in range(4) for b in (1, 3 * i + 5, 3 * i + 6)] + [1]
    parents = [255 if j % 4 == 0 else j - 1 for j in range(20)]
    return {
        "hand_scale": 1.0,
        "joint_rotation_axes": np.concatenate([*AXES, [SPREAD, FLEX]]).tolist(),
        "joint_rest_positions": rest.tolist(),
        "joint_parent": [float(p) for p in [*parents, 255, 20]],
        "joint_frame_index": [float(f) for f in [*frames, 255, 0]],
        "landmark_rest_positions": np.array(marks, dtype=float).tolist(),
        "landmark_rest_bone_indices": [[b, b, b] for b in bones],
        "landmark_rest_bone_weights": [[1.0, 0.0, 0.0]] * 21,
    }


def _walk(chain, axes, angles):
    """Places of the hinges and the tip of one finger, bone by bone, mm."""
    matrix, before, places = np.eye(4), np.zeros(3), []
    for place, axis, angle in zip(chain[:4], axes, angles, strict=True):
        step = np.eye(4)
        step[:3, 3] = place - before
        matrix = matrix @ step
        places.append(matrix[:3, 3].copy())
        step = np.eye(4)
        step[:3, :3] = rodrigues(axis * angle)
        matrix, before = matrix @ step, place
    return [*places, matrix[:3, :3] @ (chain[4] - before) + matrix[:3, 3]]
