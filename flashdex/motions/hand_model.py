"""Kinematic facts of both hands as float64 tensors, for retargeting."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from flashdex.hands.spec import HandSpec
from flashdex.keys import Side, sides_of
from flashdex.motions.hand_spheres import make_spheres

# share of its range at which a relaxed finger joint rests
RELAXED = 0.3
MIDDLE_KNUCKLE = 9


class HandModel:
    """Both hands, [left, right].

    Args:
        specs: left and right hand, as returned by ``load_hand``.

    Attributes:
        low: lower joint limits, (2, J); ``high`` likewise.
        relaxed: posture that fingers return to, (2, J).
        tip_link: distal link of each finger, (5,).
        tip_pos: pad points in the link's frame, m, (2, 5, 3).
        tip_center: end spheres, (2, 5, 3); ``tip_radius`` (2, 5).
        knuckle: middle knuckle in the base frame, m, (2, 3).
        wrist_from_palm: quaternion R_palm_base, (2, 4).
        spheres: fill of the collision geoms.
    """

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        hands = [specs[side] for side in sides_of(specs)]
        ranges = np.stack([h.joint_range for h in hands])
        self.low, self.high = torch.tensor(ranges[..., 0]), torch.tensor(ranges[..., 1])
        self.relaxed = self.low + RELAXED * (self.high - self.low)
        self.tip_link = torch.as_tensor(hands[0].tip_link)
        self.tip_pos = _stack([h.tip_pos for h in hands])
        self.tip_center = _stack([h.tip_center for h in hands])
        self.tip_radius = _stack([h.tip_radius for h in hands])
        self.wrist_from_palm = _stack([h.wrist_from_palm for h in hands])
        self.knuckle = _stack([_knuckle(h) for h in hands])
        self.spheres = make_spheres(specs)


def _stack(rows: list[np.ndarray]) -> Tensor:
    return torch.tensor(np.stack(rows), dtype=torch.float64)


def _knuckle(spec: HandSpec) -> np.ndarray:
    """Origin of the link that stands for the middle MCP, base frame, m, (3,)."""
    links = [link for link, point in spec.keypoint_links if point == MIDDLE_KNUCKLE]
    return spec.link_pos[links[0]]
