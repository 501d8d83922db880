"""Between MuJoCo's flat state and the hands and objects of a world."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from flashdex import keys
from flashdex.envs.scene.scene import Scene, parked_joint_pos
from flashdex.geometry.rotation import quat_rotate, quat_rotate_inverse
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

_EMPTY_HEIGHT = -5.0  # m; empty object slots wait below the floor


class StateMap(nn.Module):
    """Reads and writes qpos, qvel and ctrl of N worlds of one scene layout.

    Hands that take no part in a world's motion are parked, empty object slots wait out
    of reach; both read as zero (identity pose). Any scene of the collection will do.
    """

    qpos_of_joint: Tensor  # (S, J) columns, S sides that exist
    dof_of_joint: Tensor  # (S, J)
    ctrl_of_joint: Tensor  # (S, J)
    qpos_of_object: Tensor  # (O', 7), O' slots that exist
    dof_of_object: Tensor  # (O', 6)
    active: Tensor  # (M, 2) bool
    has_object: Tensor  # (M, O) bool
    own_slot: Tensor  # object slot of each hand, 0 where it has none, (M, 2)
    parked: Tensor  # (2, J)
    empty: Tensor  # (O', 7)

    def __init__(
        self, library: MotionLibrary, hands: dict[keys.Side, HandSpec], scene: Scene
    ) -> None:
        super().__init__()
        layout, model = scene.layout, scene.model
        first = keys.SIDES.index(layout.sides[0])
        self._hands = slice(first, first + len(layout.sides))  # of the two
        self.sizes = (model.nq, model.nv, model.nu)
        self.num_used = layout.num_objects
        self.num_slots = library.motions["object_index"].shape[1]
        slots = range(self.num_used)
        empty = [[0, 0, _EMPTY_HEIGHT - s, 1, 0, 0, 0] for s in slots]
        parked = np.stack([parked_joint_pos(hands[s]) for s in keys.SIDES])
        rows = library.motions["object_index"]
        slot = library.motions["hand_object"].long()
        tables = {
            "qpos_of_joint": _stack([scene.joint_qpos(s) for s in layout.sides]),
            "dof_of_joint": _stack([scene.joint_dof(s) for s in layout.sides]),
            "ctrl_of_joint": _stack([scene.joint_actuator(s) for s in layout.sides]),
            "qpos_of_object": _stack([scene.object_qpos(s) for s in slots], 7),
            "dof_of_object": _stack([scene.object_dof(s) for s in slots], 6),
            "active": library.motions["hand_active"].bool(),
            "has_object": rows >= 0,
            "own_slot": slot.clamp_min(0),
            "parked": torch.as_tensor(parked),
            "empty": torch.tensor(empty, dtype=torch.float64).reshape(-1, 7),
        }
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def read(
        self, qpos: Tensor, qvel: Tensor, motion: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Joint and object states of N worlds, float32, of qpos (N, nq), qvel (N, nv).

        Returns:
            Joint positions and velocities, (N, 2, J); object poses (N, O, 7) and
            velocities (N, O, 6), world.
        """
        active = self.active[motion].unsqueeze(-1)
        pos = self._per_hand(qpos[:, self.qpos_of_joint].float()) * active
        vel = self._per_hand(qvel[:, self.dof_of_joint].float()) * active
        return pos, vel, *self.read_objects(qpos, qvel, motion)

    def read_contact(self, contact: Tensor, motion: Tensor) -> Tensor:
        """Contact of both hands, (N, 2, L, 6), of those that exist, (N, S, L, 6)."""
        active = self.active[motion][..., None, None]
        return self._per_hand(contact.float()) * active

    def read_objects(
        self, qpos: Tensor, qvel: Tensor, motion: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Object poses (N, O, 7) and velocities (N, O, 6), world, float32."""
        n = len(motion)
        pose = qpos.new_zeros(n, self.num_slots, 7, dtype=torch.float32)
        pose[..., 3] = 1.0
        vel = qvel.new_zeros(n, self.num_slots, 6, dtype=torch.float32)
        used = self.num_used
        if used:
            has = self.has_object[motion][:, :used].unsqueeze(-1)
            found = qpos[:, self.qpos_of_object].float()
            speed = qvel[:, self.dof_of_object].float()
            # MuJoCo keeps the spin of a free joint in body axes.
            spin = quat_rotate(found[..., 3:], speed[..., 3:])
            speed = torch.cat([speed[..., :3], spin], -1)
            pose[:, :used] = torch.where(has, found, pose[:, :used])
            vel[:, :used] = torch.where(has, speed, vel[:, :used])
        return pose, vel

    def write(
        self,
        motion: Tensor,  # motion rows, (N,)
        joint_pos: Tensor,  # (N, 2, J)
        joint_vel: Tensor,  # (N, 2, J)
        object_pose: Tensor,  # (N, O, 7), world
        object_vel: Tensor,  # (N, O, 6), world
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Flat states of all worlds, float64; the inverse of ``read``.

        Returns:
            qpos (N, nq), qvel (N, nv), and ctrl (N, nu) that holds the joints there.
        """
        n, (nq, nv, _) = len(motion), self.sizes
        qpos = self.parked.new_zeros(n, nq)
        qvel = self.parked.new_zeros(n, nv)
        moves = self.active[motion].unsqueeze(-1)
        pos = torch.where(moves, joint_pos.double(), self.parked)
        vel = joint_vel.double() * moves
        qpos[:, self.qpos_of_joint] = pos[:, self._hands]
        qvel[:, self.dof_of_joint] = vel[:, self._hands]
        used = self.num_used
        if used:
            has = self.has_object[motion][:, :used].unsqueeze(-1)
            pose, speed = object_pose[:, :used], object_vel[:, :used]
            spin = quat_rotate_inverse(pose[..., 3:], speed[..., 3:])
            speed = torch.cat([speed[..., :3], spin], -1).double()
            qpos[:, self.qpos_of_object] = torch.where(has, pose.double(), self.empty)
            qvel[:, self.dof_of_object] = speed * has
        return qpos, qvel, self.controls(motion, joint_pos)

    def controls(self, motion: Tensor, target: Tensor) -> Tensor:
        """Actuator controls (N, nu), float64, of joint targets (N, 2, J)."""
        moves = self.active[motion].unsqueeze(-1)
        ctrl = torch.where(moves, target.double(), self.parked)
        out = self.parked.new_zeros(len(motion), self.sizes[2])
        out[:, self.ctrl_of_joint] = ctrl[:, self._hands]
        return out

    def targets(self, ctrl: Tensor) -> Tensor:
        """Joint targets (N, 2, J) of controls (N, nu); the inverse of ``controls``."""
        return self._per_hand(ctrl[:, self.ctrl_of_joint])

    def _per_hand(self, values: Tensor) -> Tensor:
        """Both hands from those that exist: (N, S, J) to (N, 2, J)."""
        if values.shape[1] == 2:
            return values
        out = values.new_zeros(len(values), 2, *values.shape[2:])
        out[:, self._hands] = values
        return out


def _stack(rows: list[np.ndarray] | list[int], width: int = 0) -> Tensor:
    """Columns as a table; starts of ``width`` consecutive ones when it is given."""
    table = torch.as_tensor(np.array(rows, dtype=np.int64))
    return table if width == 0 else table.reshape(-1, 1) + torch.arange(width)
