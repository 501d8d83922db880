"""Geometric Jacobians of points on the links of both hands, batched over frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from flashdex.geometry.rotation import quat_from_axis_angle, quat_rotate
from flashdex.hands.spec import SIDES, HandSpec, Side

NUM_WRIST = 6


class JointFrames:
    """World axes and anchors of all joints, (T, 2, J, 3).

    Args:
        axis: unit, world.
        anchor: a point on the axis, m, world; unused for slides.
        link_pos: link origins, m, world, (T, 2, L, 3).
        link_quat: link orientations, (T, 2, L, 4).
        moves: which joint moves which link, (L, J).
    """

    def __init__(
        self,
        axis: Tensor,
        anchor: Tensor,
        link_pos: Tensor,
        link_quat: Tensor,
        moves: Tensor,
    ) -> None:
        self.axis, self.anchor, self.moves = axis, anchor, moves
        self._pos, self._quat = link_pos, link_quat

    def points(self, link: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
        """World position (T, 2, P, 3) and Jacobian (T, 2, P, 3, J) of points on links.

        A slide moves a point by its axis; a hinge by a x (p - anchor).

        Args:
            link: of each point, (P,).
            local: in the link's frame, m, (2, P, 3).
        """
        world = self._pos[..., link, :] + quat_rotate(self._quat[..., link, :], local)
        arm = world[..., None, :] - self.anchor[..., None, :, :]
        columns = torch.linalg.cross(self.axis[..., None, :, :].expand_as(arm), arm)
        columns[..., :3, :] = self.axis[..., None, :3, :]
        columns = columns * self.moves[link][..., None]
        return world, columns.transpose(-1, -2)


class HandJacobian:
    """Joint axes of both hands from their link poses.

    Args:
        specs: left and right hand.
    """

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        hands = [specs[side] for side in SIDES]
        self._axes = torch.tensor(np.stack([h.joint_axis for h in hands]))
        self._link = torch.tensor(np.maximum(hands[0].joint_link, 0))
        self._moves = torch.tensor(_moves(hands[0])).double()

    def frames(self, q: Tensor, link_pos: Tensor, link_quat: Tensor) -> JointFrames:
        """World axes and anchors of all joints.

        Args:
            q: joint positions, (T, 2, J).
            link_pos: m, world, (T, 2, L, 3).
            link_quat: wxyz, (T, 2, L, 4).
        """
        axes = self._axes.expand(*q.shape[:-1], -1, 3)
        world = quat_rotate(link_quat[..., self._link, :], axes)
        turn = quat_from_axis_angle(axes[..., 3, :], q[..., 3])
        world[..., :4, :] = axes[..., :4, :]
        world[..., 4, :] = quat_rotate(turn, axes[..., 4, :])
        # the last wrist hinge turns about its own axis: the base orientation serves
        anchor = link_pos[..., self._link, :]
        return JointFrames(world, anchor, link_pos, link_quat, self._moves)


def _moves(spec: HandSpec) -> np.ndarray:
    """Which joint moves which link, (L, J) bool."""
    moves = np.zeros((spec.num_links, spec.num_joints), dtype=bool)
    moves[:, :NUM_WRIST] = True
    for link in range(spec.num_links):
        up = link
        while up >= 0:
            moves[link] |= spec.joint_link == up
            up = spec.link_parent[up]
    return moves
