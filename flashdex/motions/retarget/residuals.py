"""Residuals of the retargeting problem, each with its Jacobian, all in standard units.

A residual of 1 is one standard deviation of its ``RetargetWeights`` entry.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.ndimage import gaussian_filter1d
from tensordict import TensorDict
from torch import Tensor

from flashdex.geometry.rotation import (
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_rotvec,
)
from flashdex.geometry.sdf import SdfGrid
from flashdex.hands.collision_spheres import HandModel
from flashdex.hands.kinematics import JointFrames
from flashdex.motions.retarget.targets import Targets

Part = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class RetargetWeights:
    """All weights of the retargeting, as standard deviations: small means strict."""

    tip: float = 0.004  # m, robot pad to human tip
    tip_contact: float = 0.010  # m, of a finger in contact: there the surface decides
    wrist_pos: float = 0.03  # m, robot base to where the human wrist puts it
    wrist_rot: float = 0.35  # rad, robot base to the human palm
    posture: float = 1.2  # rad, fingers to a relaxed posture
    smooth_finger: float = 0.08  # rad, finger to its average over time
    smooth_wrist: float = 0.02  # m and rad, wrist to its average over time
    surface: float = 0.0007  # m, end sphere of a touching finger to its wanted depth
    pad: float = 0.0025  # m, its pad point to the surface: turns the pad to it
    clear: float = 0.001  # m, penetration of anything else into object or table
    depth: float = 0.002  # m, how far touching pads lie inside the surface
    margin: float = 0.002  # m, room between untouched object and hand
    table: float = 0.003  # m, room above the table
    damping: float = 1.0  # added to the diagonal
    free_iterations: int = 30  # before contact is considered
    contact_iterations: int = 50


class Residuals:
    """Residuals and Jacobians of all frames and both hands at a joint state.

    The distance grids have a row a slot.
    """

    def __init__(
        self, hand: HandModel, targets: Targets, sdf: SdfGrid, weights: RetargetWeights
    ) -> None:
        self.hand, self.targets, self.sdf, self.weights = hand, targets, sdf, weights

    def evaluate(
        self, q: Tensor, pose: TensorDict, frames: JointFrames, *, contact: bool
    ) -> list[Part]:
        """All residuals (T, 2, R) with Jacobians (T, 2, R, J).

        The pose of the links at q (T, 2, J) is as ``HandKinematics`` returns it; with
        ``contact``, contact and penetration count.
        """
        spheres = frames.points(self.hand.spheres.link, self.hand.spheres.pos)
        parts = [
            self._tips(frames, contact=contact),
            self._wrist_pos(pose, q.shape[-1]),
            self._wrist_rot(pose, frames),
            *self._diagonal(q),
            self._table(frames, spheres),
        ]
        if contact:
            parts += [*self._touch(frames), *self._clear(frames, spheres)]
        return parts

    def _tips(self, frames: JointFrames, *, contact: bool) -> Part:
        link = self.hand.tip_link
        world = frames.points(link, self.hand.tip_pos)
        jac = frames.full(world, link)
        strict, loose = 1 / self.weights.tip, 1 / self.weights.tip_contact
        share = self.targets.contact if contact else 0 * self.targets.contact
        scale = (strict + share * (loose - strict))[..., None]
        residual = scale * (world - self.targets.tips)
        return residual.flatten(-2), (scale[..., None] * jac).flatten(-3, -2)

    def _wrist_pos(self, pose: TensorDict, joints: int) -> Part:
        residual = (pose["wrist_pos"] - self.targets.wrist_pos) / self.weights.wrist_pos
        jac = torch.zeros(*residual.shape, joints, dtype=residual.dtype)
        jac[..., :3] = torch.eye(3, dtype=residual.dtype) / self.weights.wrist_pos
        return residual, jac

    def _wrist_rot(self, pose: TensorDict, frames: JointFrames) -> Part:
        delta = quat_mul(pose["wrist_quat"], quat_conj(self.targets.wrist_quat))
        jac = torch.zeros_like(frames.axis)
        jac[..., 3:6, :] = frames.axis[..., 3:6, :]
        scale = 1 / self.weights.wrist_rot
        return scale * quat_to_rotvec(delta), scale * jac.transpose(-1, -2)

    def _diagonal(self, q: Tensor) -> list[Part]:
        """Posture, and distance to the joint's own average over time."""
        smooth = torch.tensor(gaussian_filter1d(q.numpy(), 2.0, axis=0, mode="nearest"))
        posture = torch.full_like(q, 1 / self.weights.posture)
        posture[..., :6] = 0.0
        steady = torch.full_like(q, 1 / self.weights.smooth_finger)
        steady[..., :6] = 1 / self.weights.smooth_wrist
        return [
            (posture * (q - self.hand.relaxed), torch.diag_embed(posture)),
            (steady * (q - smooth), torch.diag_embed(steady)),
        ]

    def _table(self, frames: JointFrames, world: Tensor) -> Part:
        up = torch.tensor([0.0, 0.0, 1.0], dtype=world.dtype).expand_as(world)
        gap = self.hand.spheres.radius + self.weights.table
        return self._keep_out(frames, world, gap - world[..., 2], up)

    def _touch(self, frames: JointFrames) -> list[Part]:
        """Touching fingers: end spheres at the wanted depth, pads on the surface."""
        hand, weights, share = self.hand, self.weights, self.targets.contact
        parts = []
        for local, gap, scale in (
            (hand.tip_center, hand.tip_radius - weights.depth, share / weights.surface),
            (hand.tip_pos, torch.zeros(()), share / weights.pad),
        ):
            world = frames.points(hand.tip_link, local)
            distance, slope = self._query(world, self.targets.hand_object)
            jac = frames.along(world, slope, hand.tip_link)
            parts.append((scale * (distance - gap), scale[..., None] * jac))
        return parts

    def _clear(self, frames: JointFrames, world: Tensor) -> list[Part]:
        """Penetration of all spheres into all objects; touching tips may, a little."""
        spheres, weights = self.hand.spheres, self.weights
        touch = self.targets.contact[..., spheres.distal.clamp_min(0)]
        touch = torch.where(spheres.distal >= 0, touch, 0.0)
        gap = spheres.radius + weights.margin - touch * (weights.margin + weights.depth)
        parts = []
        for slot in range(self.targets.object_pos.shape[1]):
            slots = torch.full_like(self.targets.hand_object, slot)
            distance, slope = self._query(world, slots)
            parts.append(self._keep_out(frames, world, gap - distance, slope))
        return parts

    def _keep_out(
        self, frames: JointFrames, world: Tensor, depth: Tensor, slope: Tensor
    ) -> Part:
        """Spheres that are too deep, pushed along a slope."""
        hit = (depth > 0).to(depth.dtype) / self.weights.clear
        jac = frames.along(world, slope, self.hand.spheres.link)
        return hit * depth, -hit[..., None] * jac

    def _query(self, world: Tensor, slot: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (T, 2, P) and world gradient of points to one object a hand."""
        row = slot.clamp_min(0)
        pos = self.targets.object_pos[:, row][..., None, :]
        quat = self.targets.object_quat[:, row][..., None, :]
        quat = quat.expand(*world.shape[:-1], 4)
        distance, slope = self.sdf.query(
            quat_rotate_inverse(quat, world - pos), slot[:, None]
        )
        return distance, quat_rotate(quat, slope)
