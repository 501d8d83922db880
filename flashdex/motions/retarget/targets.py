"""What the retargeting aims at: joints, tips and wrists of the human hand."""

from __future__ import annotations

import numpy as np
import torch

from flashdex.geometry.rotation import quat_mul, quat_rotate
from flashdex.hands.collision_spheres import HandModel
from flashdex.motions.align import AlignedDemo
from flashdex.motions.contact.fingertips import blend
from flashdex.motions.retarget.residuals import Targets

# where the joints of a hand that takes no part rest, m: out of everyone's way
PARKED = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
MIDDLE_KNUCKLE = 9


def make_targets(aligned: AlignedDemo, hand: HandModel) -> Targets:
    """What the robot hands should reach in every frame.

    The base is placed so that the robot's middle knuckle meets the human one: the
    robot's palm is longer than a human's.
    """
    palm = torch.tensor(aligned.palm)
    wrist_quat = quat_mul(palm[..., 3:], hand.wrist_from_palm.expand_as(palm[..., 3:]))
    keypoints = torch.tensor(aligned.keypoints)
    arm = quat_rotate(wrist_quat, hand.knuckle.expand(*palm.shape[:-1], 3))
    poses = torch.tensor(np.stack(aligned.poses, axis=1))
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=palm.dtype)
    weight = np.stack([blend(aligned.contact[:, h]) for h in range(2)], axis=1)
    return Targets(
        tips=keypoints[..., [4, 8, 12, 16, 20], :],
        wrist_pos=keypoints[..., MIDDLE_KNUCKLE, :] - arm,
        wrist_quat=wrist_quat,
        contact=torch.tensor(weight),
        hand_object=torch.tensor(aligned.hand_object),
        object_pos=poses[..., :3],
        object_quat=poses[..., 3:],
        palm_normal=quat_rotate(palm[..., 3:], normal.expand(*palm.shape[:-1], 3)),
    )


def _park(joint_pos: np.ndarray, *, acting: np.ndarray) -> np.ndarray:
    """Both hands (T, 2, J) from the acting ones (T, H, J); the other one rests."""
    both = np.zeros((len(joint_pos), 2, joint_pos.shape[-1]))
    both[..., :3] = PARKED
    both[:, acting] = joint_pos
    return both
