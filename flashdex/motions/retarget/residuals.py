"""Residuals of the retargeting problem, each with its Jacobian, all in standard units.

A residual of 1 is one standard deviation of its ``RetargetWeights`` entry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from flashdex.hands.jacobian import JointFrames

Part = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class RetargetWeights:
    """All weights of the retargeting, as standard deviations: small means strict.

    Args:
        tip: m, robot pad to human tip.
        tip_contact: m, the same for a finger in contact, where the surface decides.
        wrist_pos: m, robot base to where the human wrist puts it.
        wrist_rot: rad, robot base to the human palm.
        posture: rad, fingers to a relaxed posture.
        smooth_finger: rad, finger to its average over time.
        smooth_wrist: m and rad, wrist to its average over time.
        surface: m, end sphere of a touching finger to its wanted depth.
        pad: m, pad point of a touching finger to the surface: turns the pad to it.
        clear: m, penetration of anything else into object or table.
        depth: m, how far touching pads lie inside the surface.
        margin: m, room between untouched object and hand.
        table: m, room above the table.
        damping: added to the diagonal.
        free_iterations: before contact is considered.
        contact_iterations: with contact.
    """

    tip: float = 0.004
    tip_contact: float = 0.010
    wrist_pos: float = 0.03
    wrist_rot: float = 0.35
    posture: float = 1.2
    smooth_finger: float = 0.08
    smooth_wrist: float = 0.02
    surface: float = 0.0007
    pad: float = 0.0025
    clear: float = 0.001
    depth: float = 0.002
    margin: float = 0.002
    table: float = 0.003
    damping: float = 1.0
    free_iterations: int = 30
    contact_iterations: int = 50


@dataclass
class Targets:
    """What the human hands and the objects do; [left, right]; float64.

    Args:
        tips: human fingertips, m, world, (T, 2, 5, 3).
        wrist_pos: wanted base position, m, (T, 2, 3).
        wrist_quat: wanted base orientation, (T, 2, 4).
        contact: weight of contact in 0..1, (T, 2, 5).
        hand_object: slot of each hand's object, -1 for none, (2,).
        object_pos: m, (T, O, 3).
        object_quat: (T, O, 4).
        palm_normal: out of the palm, unit, (T, 2, 3).
    """

    tips: Tensor
    wrist_pos: Tensor
    wrist_quat: Tensor
    contact: Tensor
    hand_object: Tensor
    object_pos: Tensor
    object_quat: Tensor
    palm_normal: Tensor

    def of(self, hands: Tensor) -> Targets:
        """The targets of some hands only.

        Args:
            hands: rows of the hand axis, int64.
        """
        return replace(
            self,
            tips=self.tips[:, hands],
            wrist_pos=self.wrist_pos[:, hands],
            wrist_quat=self.wrist_quat[:, hands],
            contact=self.contact[:, hands],
            hand_object=self.hand_object[hands],
            palm_normal=self.palm_normal[:, hands],
        )


class Residuals:
    """Residuals and Jacobians of all frames and both hands at a joint state.

    Args:
        hand: kinematic facts of both hands.
        targets: what the human hands and the objects do.
        sdf: distance grids of the objects, by slot.
        weights: standard deviations.
    """

    def __init__(
        self, hand: HandModel, targets: Targets, sdf: SdfGrid, weights: RetargetWeights
    ) -> None:
        self.hand, self.targets, self.sdf, self.weights = hand, targets, sdf, weights
        self._center_gap = hand.tip_radius - weights.depth

    def evaluate(
        self, q: Tensor, pose: TensorDict, frames: JointFrames, *, contact: bool
    ) -> list[Part]:
        """All residuals (T, 2, R) with Jacobians (T, 2, R, J).

        Args:
            q: joint positions, (T, 2, J).
            pose: of the links, as ``HandKinematics`` returns it.
            frames: joint axes of that pose.
            contact: whether contact and penetration count.
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
            parts += [self._surface(frames), self._pads(frames)]
            parts += self._clear(frames, spheres)
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
        spheres = self.hand.spheres
        depth = spheres.radius + self.weights.table - world[..., 2]
        hit = (depth > 0).to(depth.dtype) / self.weights.clear
        up = torch.tensor([0.0, 0.0, 1.0], dtype=world.dtype).expand_as(world)
        return hit * depth, -hit[..., None] * frames.along(world, up, spheres.link)

    def _surface(self, frames: JointFrames) -> Part:
        """End spheres of touching fingers at the wanted depth."""
        scale = self.targets.contact / self.weights.surface
        return self._touch(frames, self.hand.tip_center, self._center_gap, scale)

    def _pads(self, frames: JointFrames) -> Part:
        """Pad points of touching fingers on the surface: turns the pads to it."""
        scale = self.targets.contact / self.weights.pad
        return self._touch(frames, self.hand.tip_pos, torch.zeros(()), scale)

    def _touch(
        self, frames: JointFrames, local: Tensor, gap: Tensor, scale: Tensor
    ) -> Part:
        link = self.hand.tip_link
        world = frames.points(link, local)
        distance, slope = self._query(world, self.targets.hand_object)
        jac = frames.along(world, slope, link)
        return scale * (distance - gap), scale[..., None] * jac

    def _clear(self, frames: JointFrames, world: Tensor) -> list[Part]:
        """Penetration of all spheres into all objects; touching tips may, a little."""
        spheres, weights = self.hand.spheres, self.weights
        touch = self.targets.contact[..., spheres.distal.clamp_min(0)]
        touch = torch.where(spheres.distal >= 0, touch, 0.0)
        gap = spheres.radius + weights.margin - touch * (weights.margin + weights.depth)
        parts = []
        for slot in range(self.targets.object_pos.shape[1]):
            distance, slope = self._query(
                world, torch.full_like(self.targets.hand_object, slot)
            )
            depth = gap - distance
            hit = (depth > 0).to(depth.dtype) / weights.clear
            jac = frames.along(world, slope, spheres.link)
            parts.append((hit * depth, -hit[..., None] * jac))
        return parts

    def _query(self, world: Tensor, slot: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (T, 2, P) and world gradient of points to one object a hand."""
        row = slot.clamp_min(0)
        pos = self.targets.object_pos[:, row][..., None, :]
        quat = self.targets.object_quat[:, row][..., None, :]
        local = quat_rotate_inverse(quat.expand(*world.shape[:-1], 4), world - pos)
        distance, slope = self.sdf.query(local, slot[:, None])
        return distance, quat_rotate(quat.expand(*world.shape[:-1], 4), slope)
