"""Kinematics of both hands in torch, batched over worlds, hands and fingers.

Forward kinematics (poses and velocities), and the Jacobians of points on the links.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor, nn

from flashdex.geometry.rotation import quat_from_axis_angle, quat_mul, quat_rotate
from flashdex.hands.gains import NUM_WRIST_JOINTS
from flashdex.hands.spec import HandError, HandSpec
from flashdex.keys import Side, sides_of

NUM_SLIDES = 3  # of the wrist; its other joints, and all of the fingers, are hinges
Pose = tuple[Tensor, Tensor]
Twist = tuple[Tensor, Tensor]


class HandKinematics(nn.Module):
    """Poses and velocities of wrist, links and fingertips from joint states.

    Links of equal depth in the tree are computed together, for both hands at once: the
    work is a few tensor operations a level (four levels on the XHand). All outputs are
    in the world frame, which is the frame the wrist slides move in.

    Args:
        specs: the hands of one embodiment, as returned by ``load_hand``; mostly both,
            and where shapes say 2, as many as there are.

    Raises:
        HandError: the hands have different trees.

    Example:
        >>> from flashdex.hands.spec import load_hand
        >>> kinematics = HandKinematics(load_hand("xhand"))
        >>> out = kinematics(torch.zeros(512, 2, 18), torch.zeros(512, 2, 18))
        >>> out["tip_pos"].shape, out["link_quat"].shape
        (torch.Size([512, 2, 5, 3]), torch.Size([512, 2, 13, 4]))
    """

    # link arrays are stored by depth, base first, so that a level is a slice; H hands
    link_pos: Tensor  # (H, L, 3)
    link_quat: Tensor  # (H, L, 4)
    link_axis: Tensor  # (H, L, 3), zero for a welded link
    link_joint: Tensor  # (L,)
    link_slot: Tensor  # (L,) row of the parent within the level above
    link_order: Tensor  # (L,) row of each link of the spec
    link_sorted: Tensor  # (L,) link of the spec in each row
    wrist_axes: Tensor  # (H, 6, 3)
    tip_link: Tensor  # (5,)
    tip_pos: Tensor  # (H, 5, 3)
    tip_center: Tensor  # (H, 5, 3)

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        super().__init__()
        hands = [specs[side] for side in sides_of(specs)]
        _refuse_different_trees(hands[0], hands[-1])
        depth = _lineage(hands[0]).sum(axis=1) - 1
        order = np.argsort(depth, kind="stable")
        starts = np.flatnonzero(np.diff(depth[order], prepend=-1))
        self._levels = [slice(a, b) for a, b in pairwise([*starts, len(order)])]
        joint, slot = _link_tables(hands[0], depth, order)
        moves = (joint >= 0)[:, None]
        values: dict[str, list[NDArray[np.float64]]] = {
            "link_pos": [h.link_pos[order] for h in hands],
            "link_quat": [h.link_quat[order] for h in hands],
            "link_axis": [h.joint_axis[joint] * moves for h in hands],
            "wrist_axes": [h.wrist_axes for h in hands],
            "tip_pos": [h.tip_pos for h in hands],
            "tip_center": [h.tip_center for h in hands],
        }
        tables = {
            "link_joint": np.maximum(joint, 0),
            "link_slot": slot,
            "link_order": np.argsort(order),
            "link_sorted": order,
            "tip_link": hands[0].tip_link,
        }
        for name, rows in values.items():
            tensor = torch.tensor(np.stack(rows), dtype=torch.float32)
            self.register_buffer(name, tensor, persistent=False)
        for name, table in tables.items():
            self.register_buffer(name, torch.as_tensor(table), persistent=False)

    def forward(self, joint_pos: Tensor, joint_vel: Tensor | None = None) -> TensorDict:
        """Compute world poses, and velocities if joint velocities are given.

        Args:
            joint_pos: m and rad, (..., 2, J), wrist joints first.
            joint_vel: m/s and rad/s, (..., 2, J), or None.

        Returns:
            TensorDict of batch size (..., 2): ``wrist_pos`` (3), ``wrist_quat`` (4) of
            the base link; ``link_pos`` (L, 3), ``link_quat`` (L, 4); ``tip_pos``,
            ``tip_center`` (5, 3). With velocities also ``wrist_linvel``,
            ``wrist_angvel`` (3); ``link_linvel`` of the link origins, ``link_angvel``
            (L, 3); ``tip_linvel`` of the tracking points (5, 3).
        """
        turns = self._wrist_turns(joint_pos)
        (pos, quat), arms = self._poses(joint_pos, turns)
        tip_quat = quat[..., self.tip_link, :]
        tip_arm = quat_rotate(tip_quat, self.tip_pos)
        tip_origin = pos[..., self.tip_link, :]
        out = {
            "wrist_pos": pos[..., 0, :],
            "wrist_quat": quat[..., 0, :],
            "link_pos": pos,
            "link_quat": quat,
            "tip_pos": tip_origin + tip_arm,
            "tip_center": tip_origin + quat_rotate(tip_quat, self.tip_center),
        }
        if joint_vel is not None:
            linvel, angvel = self._velocities(turns, joint_vel, quat, arms)
            turn = torch.linalg.cross(angvel[..., self.tip_link, :], tip_arm)
            out["wrist_linvel"] = linvel[..., 0, :]
            out["wrist_angvel"] = angvel[..., 0, :]
            out["link_linvel"] = linvel
            out["link_angvel"] = angvel
            out["tip_linvel"] = linvel[..., self.tip_link, :] + turn
        return TensorDict(out, batch_size=joint_pos.shape[:-1])

    def _poses(self, joint_pos: Tensor, turns: Tensor) -> tuple[Pose, list[Tensor]]:
        # also returns the lever arms of the levels, world axes, for the velocities
        angle = joint_pos[..., self.link_joint]
        local = quat_mul(self.link_quat, quat_from_axis_angle(self.link_axis, angle))
        slides = joint_pos[..., :3, None] * self.wrist_axes[:, :3]
        pos = [slides.sum(-2, keepdim=True)]
        quat = [turns[..., -1:, :]]
        arms = []
        for level in self._levels[1:]:
            slot = self.link_slot[level]
            parent_quat = quat[-1][..., slot, :]
            arms.append(quat_rotate(parent_quat, self.link_pos[:, level]))
            pos.append(pos[-1][..., slot, :] + arms[-1])
            quat.append(quat_mul(parent_quat, local[..., level, :]))
        return (self._sort(pos), self._sort(quat)), arms

    def _velocities(
        self, turns: Tensor, joint_vel: Tensor, quat: Tensor, arms: list[Tensor]
    ) -> Twist:
        # v_c = v_p + w_p x (p_c - p_p);  w_c = w_p + R_c a q'. A hinge does not move
        # its own axis, so the orientation after the turn serves.
        wrist_spin = quat_rotate(turns, self.wrist_axes[:, 3:])
        wrist_spin = wrist_spin * joint_vel[..., 3:NUM_WRIST_JOINTS, None]
        slides = joint_vel[..., :3, None] * self.wrist_axes[:, :3]
        linvel = [slides.sum(-2, keepdim=True)]
        angvel = [wrist_spin.sum(-2, keepdim=True)]
        axis_w = quat_rotate(quat[..., self.link_sorted, :], self.link_axis)
        spin = axis_w * joint_vel[..., self.link_joint, None]
        for level, arm in zip(self._levels[1:], arms, strict=True):
            slot = self.link_slot[level]
            parent_angvel = angvel[-1][..., slot, :]
            turn = torch.linalg.cross(parent_angvel, arm)
            linvel.append(linvel[-1][..., slot, :] + turn)
            angvel.append(parent_angvel + spin[..., level, :])
        return self._sort(linvel), self._sort(angvel)

    def _wrist_turns(self, joint_pos: Tensor) -> Tensor:
        # orientation after each hinge, (..., 3, 4): R_z, R_z R_x, R_z R_x R_-y
        angles = joint_pos[..., 3:NUM_WRIST_JOINTS]
        turns = quat_from_axis_angle(self.wrist_axes[:, 3:], angles)
        first, second, third = turns.unbind(-2)
        second = quat_mul(first, second)
        return torch.stack((first, second, quat_mul(second, third)), dim=-2)

    def _sort(self, levels: list[Tensor]) -> Tensor:
        return torch.cat(levels, dim=-2)[..., self.link_order, :]


def _lineage(hand: HandSpec) -> NDArray[np.bool_]:
    """Which link hangs on which, itself included, (L, L)."""
    lineage = np.eye(hand.num_links, dtype=bool)
    for link, parent in enumerate(hand.link_parent):  # parents come first
        if parent >= 0:
            lineage[link] |= lineage[parent]
    return lineage


def _link_tables(
    hand: HandSpec, depth: NDArray[np.int64], order: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    # by row: joint of the link (-1 if welded), row of its parent in the level above
    joint = np.full(hand.num_links, -1, dtype=np.int64)
    moved = hand.joint_link >= 0
    joint[hand.joint_link[moved]] = np.flatnonzero(moved)
    row = np.array([int((depth[:i] == depth[i]).sum()) for i in range(len(depth))])
    slot = np.where(hand.link_parent >= 0, row[hand.link_parent], 0)
    return joint[order], slot[order]


def _refuse_different_trees(left: HandSpec, right: HandSpec) -> None:
    for field in ("link_parent", "joint_link", "tip_link"):
        if not np.array_equal(getattr(left, field), getattr(right, field)):
            raise HandError(
                f"{left.name}, {right.name}: {field} differs between left and right. "
                "Both sides must have the same links and joints in the same order."
            )


@dataclass(frozen=True)
class JointFrames:
    """World axes of all joints in every frame, and what they do to points."""

    axis: Tensor  # unit, (T, 2, J, 3)
    turn: Tensor  # axis a of a hinge, zero for a slide, (T, 2, 3, J)
    shift: Tensor  # a x c, c on the axis; minus the axis of a slide, (T, 2, 3, J)
    link_pos: Tensor  # m, (T, 2, L, 3)
    link_quat: Tensor  # (T, 2, L, 4)
    moves: Tensor  # which joint moves which link, (L, J)

    def points(self, link: Tensor, local: Tensor) -> Tensor:
        """World positions of points on links, m, (T, 2, P, 3).

        Args:
            link: of each point, (P,).
            local: in the link's frame, m, (2, P, 3).
        """
        arm = quat_rotate(self.link_quat[..., link, :], local)
        return self.link_pos[..., link, :] + arm

    def along(self, world: Tensor, direction: Tensor, link: Tensor) -> Tensor:
        """How fast points move along given directions, per joint, (T, 2, P, J).

        A slide moves a point by its axis, a hinge by a x (p - c); the latter along n is
        a . (p x n) - (a x c) . n, two matrix products for all points and joints.

        Args:
            world: points p, m, (T, 2, P, 3).
            direction: n, world, (T, 2, P, 3).
            link: of each point, (P,).
        """
        moment = torch.linalg.cross(world, direction)
        return (moment @ self.turn - direction @ self.shift) * self.moves[link]

    def full(self, world: Tensor, link: Tensor) -> Tensor:
        """Jacobian of points, rows x, y, z, (T, 2, P, 3, J)."""
        axes = torch.eye(3, dtype=world.dtype)
        rows = [self.along(world, axis.expand_as(world), link) for axis in axes]
        return torch.stack(rows, dim=-2)


class HandJacobian:
    """Joint axes of one hand or both from their link poses."""

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        hands = [specs[side] for side in sides_of(specs)]
        self._axes = torch.tensor(np.stack([h.joint_axis for h in hands]))
        self._link = torch.tensor(np.maximum(hands[0].joint_link, 0))
        moves = np.ones((hands[0].num_links, hands[0].num_joints))
        fingers = hands[0].joint_link[NUM_WRIST_JOINTS:]
        moves[:, NUM_WRIST_JOINTS:] = _lineage(hands[0])[:, fingers]
        self._moves = torch.tensor(moves)

    def frames(self, q: Tensor, link_pos: Tensor, link_quat: Tensor) -> JointFrames:
        """World axes and anchors of all joints.

        Args:
            q: joint positions, (T, 2, J).
            link_pos: m, world, (T, 2, L, 3).
            link_quat: wxyz, (T, 2, L, 4).
        """
        axes = self._axes.expand(*q.shape[:-1], -1, 3)
        world = quat_rotate(link_quat[..., self._link, :], axes)
        first = quat_from_axis_angle(axes[..., 3, :], q[..., 3])
        world[..., :4, :] = axes[..., :4, :]
        world[..., 4, :] = quat_rotate(first, axes[..., 4, :])
        # the last wrist hinge turns about its own axis: the base orientation serves
        turn = world.clone()
        turn[..., :NUM_SLIDES, :] = 0.0
        shift = torch.linalg.cross(turn, link_pos[..., self._link, :])
        shift[..., :NUM_SLIDES, :] = -world[..., :NUM_SLIDES, :]
        turn, shift = turn.mT.contiguous(), shift.mT.contiguous()
        return JointFrames(world, turn, shift, link_pos, link_quat, self._moves)
