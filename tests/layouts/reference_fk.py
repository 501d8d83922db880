"""Forward kinematics of MANO in its plainest form: loops and 4x4 matrices.

The tests compare the package with this; it shares no line with it.
"""

from __future__ import annotations

import numpy as np

from layouts.mano_files import PARENTS, TIPS

# thumb, index, middle, ring, pinky: MCP, PIP, DIP in the order of the joints
FINGERS = [(13, 14, 15), (1, 2, 3), (4, 5, 6), (10, 11, 12), (7, 8, 9)]


def rodrigues(vector):
    """Rotation matrix of an axis-angle vector."""
    angle = float(np.sqrt(vector @ vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def shaped(hand, betas):
    """Vertices at rest."""
    return hand.v_template + sum(
        b * hand.shapedirs[..., i] for i, b in enumerate(betas)
    )


def skin_frame(hand, rest, rotations):
    """Joints (16, 3) and vertices (778, 3) of one frame; the root turns about J0.

    Args:
        hand: arrays of the model.
        rest: vertices at rest, after shaping.
        rotations: local, (16, 3, 3).
    """
    places = hand.regressor @ rest
    feature = []
    for joint in range(1, 16):
        feature += list((rotations[joint] - np.eye(3)).ravel())
    bent = rest + hand.posedirs @ np.array(feature)
    world, rest_inverse = [], []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = places[joint] - (places[parent] if joint else 0.0)
        world.append(world[parent] @ local if joint else local)
        back = np.eye(4)
        back[:3, 3] = -places[joint]
        rest_inverse.append(back)
    points = np.concatenate([bent, np.ones((len(bent), 1))], axis=1)
    vertices = np.zeros((len(bent), 4))
    for joint in range(16):
        moved = points @ (world[joint] @ rest_inverse[joint]).T
        vertices += hand.weights[:, joint : joint + 1] * moved
    return np.array([w[:3, 3] for w in world]), vertices[:, :3]


def keypoints_frame(side, joints, vertices):
    """The 21 keypoints: wrist, then each finger from the thumb on, its tip last."""
    points = [joints[0]]
    for tip, finger in zip(TIPS[side], FINGERS, strict=True):
        points += [joints[j] for j in finger] + [vertices[tip]]
    return np.array(points)


def wrist_keypoints(side, hand, rest, rotations, wrist):
    """Keypoints (T, 21, 3) with the wrist joint at ``wrist`` (T, 3)."""
    out = []
    for turn, place in zip(rotations, wrist, strict=True):
        joints, vertices = skin_frame(hand, rest, turn)
        points = keypoints_frame(side, joints, vertices)
        out.append(points - joints[0] + place)
    return np.array(out)
