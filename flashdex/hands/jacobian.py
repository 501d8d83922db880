"""Geometric Jacobians of points on the links of both hands, batched over frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from flashdex.geometry.rotation import quat_from_axis_angle, quat_rotate
from flashdex.hands.spec import HandSpec
from flashdex.keys import Side, sides_of

NUM_WRIST, NUM_SLIDES = 6, 3


class JointFrames:
    """World axes and anchors of all joints, (T, 2, J, 3), and what they do to points.

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
        self.axis, self.moves = axis, moves
        hinge = torch.ones(axis.shape[-2], 1, dtype=axis.dtype)
        hinge[:NUM_SLIDES] = 0.0
        slide = (1 - hinge) * axis
        shift = torch.linalg.cross(hinge * axis, anchor) - slide
        self._turn, self._shift = (hinge * axis).mT.contiguous(), shift.mT.contiguous()
        self._pos, self._quat = link_pos, link_quat

    def points(self, link: Tensor, local: Tensor) -> Tensor:
        """World positions of points on links, m, (T, 2, P, 3).

        Args:
            link: of each point, (P,).
            local: in the link's frame, m, (2, P, 3).
        """
        return self._pos[..., link, :] + quat_rotate(self._quat[..., link, :], local)

    def along(self, world: Tensor, direction: Tensor, link: Tensor) -> Tensor:
        """How fast points move along given directions, per joint, (T, 2, P, J).

        A slide moves a point by its axis, a hinge by a x (p - c); the latter along n is
        a . (p x n) - (a x c) . n, two matrix products for all points and joints.

        Args:
            world: points, m, (T, 2, P, 3).
            direction: n, world, (T, 2, P, 3).
            link: of each point, (P,).
        """
        moment = torch.linalg.cross(world, direction)
        columns = moment @ self._turn - direction @ self._shift
        return columns * self.moves[link]

    def full(self, world: Tensor, link: Tensor) -> Tensor:
        """Jacobian of points, rows x, y, z, (T, 2, P, 3, J)."""
        rows = [
            self.along(world, axis.expand_as(world), link)
            for axis in torch.eye(3, dtype=world.dtype)
        ]
        return torch.stack(rows, dim=-2)


class HandJacobian:
    """Joint axes of both hands from their link poses.

    Args:
        specs: left and right hand.
    """

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        hands = [specs[side] for side in sides_of(specs)]
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
