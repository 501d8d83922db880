"""What the retargeting aims at: tips and wrists of the human hands, and the objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from flashdex.geometry.rotation import quat_mul, quat_rotate
from flashdex.hands.collision_spheres import MIDDLE_KNUCKLE, HandModel
from flashdex.keys import TIP_KEYPOINTS
from flashdex.motions.contact.fingertips import blend
from flashdex.motions.contact.roles import Interaction


@dataclass
class Targets:
    """What the human hands and the objects do; [left, right]; float64."""

    tips: Tensor  # human fingertips, m, world, (T, 2, 5, 3)
    wrist_pos: Tensor  # wanted base position, m, (T, 2, 3)
    wrist_quat: Tensor  # wanted base orientation, (T, 2, 4)
    contact: Tensor  # weight of contact in 0..1, (T, 2, 5)
    hand_object: Tensor  # slot of each hand's object, -1 for none, (2,)
    object_pos: Tensor  # m, (T, O, 3)
    object_quat: Tensor  # (T, O, 4)
    palm_normal: Tensor  # out of the palm, unit, (T, 2, 3)

    def of(self, hands: Tensor) -> Targets:
        """The targets of some hands only, given as rows of the hand axis, int64."""
        tracks = ("tips", "wrist_pos", "wrist_quat", "contact", "palm_normal")
        chosen = {name: getattr(self, name)[:, hands] for name in tracks}
        return replace(self, hand_object=self.hand_object[hands], **chosen)


def make_targets(motion: Interaction, hand: HandModel) -> Targets:
    """What the robot hands should reach in every frame.

    The base is placed so that the robot's middle knuckle meets the human one: the
    robot's palm is longer than a human's.
    """
    palm_quat = torch.tensor(motion.palm)[..., 3:]
    wrist_quat = quat_mul(palm_quat, hand.wrist_from_palm.expand_as(palm_quat))
    keypoints = torch.tensor(motion.keypoints)
    arm = quat_rotate(wrist_quat, hand.knuckle.expand(*palm_quat.shape[:-1], 3))
    poses = torch.tensor(np.stack(motion.poses, axis=1))
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=palm_quat.dtype)
    return Targets(
        tips=keypoints[..., list(TIP_KEYPOINTS), :],
        wrist_pos=keypoints[..., MIDDLE_KNUCKLE, :] - arm,
        wrist_quat=wrist_quat,
        contact=torch.tensor(blend(motion.contact)),
        hand_object=torch.tensor(motion.hand_object),
        object_pos=poses[..., :3],
        object_quat=poses[..., 3:],
        palm_normal=quat_rotate(palm_quat, normal.expand(*palm_quat.shape[:-1], 3)),
    )
