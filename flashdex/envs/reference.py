"""The motion library as tensors that an environment step can gather from."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from flashdex import keys
from flashdex.geometry.rotation import quat_to_matrix
from flashdex.geometry.sdf import SdfGrid
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary


class ReferenceBank(nn.Module):
    """Reference frames, packed so that any (motion, frame) costs one gather.

    Every per-frame quantity lies side by side in one wide table; reading the state
    of N worlds is a single ``index_select`` and a few views. Quantities of "the
    object of a hand" are resolved here, once, so that no later code looks up slots. The
    hands are there for the mapped keypoints. ``targets`` (F, 2, J) make the servos
    follow the joints, see ``reference_targets``; the joints themselves when None.
    """

    table: Tensor  # (F, all columns)
    future: Tensor  # (F, 2 * 45)
    start: Tensor  # (M,)
    length: Tensor  # (M,)
    hand_active: Tensor  # hand takes part in the motion, (M, 2) bool
    has_object: Tensor  # (M, 2)
    hand_slot: Tensor  # object slot of each hand, 0 where it has none, (M, 2) int64
    hand_object: Tensor  # object row of each hand, 0 where it has none, (M, 2) int64
    object_index: Tensor  # (M, O)
    points: Tensor  # object frame, m, (Q, P, 3)
    radius: Tensor  # m, (Q,)
    mass: Tensor  # kg, (Q,)
    inertia: Tensor  # about the mass centre, object axes, kg m^2, (Q, 3, 3)
    com: Tensor  # object frame, m, (Q, 3)

    def __init__(
        self,
        library: MotionLibrary,
        hands: dict[keys.Side, HandSpec],
        targets: Tensor | None = None,
    ) -> None:
        super().__init__()
        # Columns of the packed table and the shape they are read back with.
        self._fields: dict[str, tuple[slice, tuple[int, ...]]] = {}
        frames, motions = library.frames, library.motions
        start = motions["start"].long()
        length = motions["length"].long()
        active = motions["hand_active"].bool()
        slot = motions["hand_object"].long()
        rows = motions["object_index"].long()
        motion_of_frame = torch.repeat_interleave(torch.arange(len(start)), length)
        columns = self._columns(frames, slot[motion_of_frame], hands)
        pos = columns["joint_pos"]
        columns["joint_target"] = pos if targets is None else targets.float()
        self.register_buffer("table", self._pack(columns))
        self.register_buffer("future", _pack_future(columns))
        self.register_buffer("start", start)
        self.register_buffer("length", length)
        self.register_buffer("hand_active", active)
        # Hands that no motion of the collection uses cost nothing downstream.
        self.used_hands = [i for i in range(2) if bool(active[:, i].any())]
        self.register_buffer("has_object", (slot >= 0) & active)
        self.register_buffer("hand_slot", slot.clamp_min(0))
        self.register_buffer("object_index", rows)
        own = torch.gather(rows, 1, slot.clamp_min(0)).clamp_min(0)
        self.register_buffer("hand_object", own)
        objects = library.objects
        for name in ("points", "radius", "mass", "inertia", "com"):
            self.register_buffer(name, objects[name].float())
        self.sdf = SdfGrid(
            objects["sdf"].float(),
            objects["sdf_origin"].float(),
            objects["sdf_spacing"].float(),
        )
        self.names = list(library.names)
        self.fps = float(library.fps)

    @property
    def num_motions(self) -> int:
        """Motions in the collection."""
        return len(self.start)

    @property
    def num_slots(self) -> int:
        """Object slots of a world."""
        return self.object_index.shape[1]

    @property
    def num_joints(self) -> int:
        """Joints of one hand, wrist included."""
        return self._fields["joint_pos"][1][-1]

    def at(
        self, motion: Tensor, frame: Tensor, names: tuple[str, ...] = ()
    ) -> TensorDict:
        """Gather reference frames; frames past the end clamp to the last one.

        Motion rows and frames within them have any shape B, int64. Returns the named
        fields of the packed table, all when no name is given, batch B.
        """
        frame = torch.minimum(frame.clamp_min(0), self.length[motion] - 1)
        index = self.start[motion] + frame
        rows = self.table.index_select(0, index.reshape(-1))
        rows = rows.reshape(*index.shape, -1)
        out = {
            name: rows[..., columns].unflatten(-1, shape)
            for name, (columns, shape) in self._fields.items()
            if not names or name in names
        }
        return TensorDict(out, batch_size=index.shape)

    def window(
        self, motion: Tensor, frame: Tensor, horizon: int
    ) -> tuple[Tensor, Tensor]:
        """Gather ``horizon`` consecutive frames that begin at ``frame``.

        Args:
            motion: motion rows, (N,), int64.
            frame: first frame, (N,), int64.
            horizon: number of frames K.

        Returns:
            Vectors (N, K, 2, 9, 3): object position, linear and angular velocity, wrist
            position, five fingertips; and the transposed rotation matrices of object
            and wrist, (N, K, 2, 2, 3, 3). World frame.
        """
        steps = torch.arange(horizon, device=frame.device)
        frames = frame.unsqueeze(-1) + steps
        last = (self.length[motion] - 1).unsqueeze(-1)
        index = self.start[motion].unsqueeze(-1) + torch.minimum(frames, last)
        rows = self.future.index_select(0, index.reshape(-1))
        rows = rows.unflatten(0, index.shape).unflatten(-1, (2, 45))
        vectors, rotations = rows.split([27, 18], -1)
        return vectors.unflatten(-1, (9, 3)), rotations.unflatten(-1, (2, 3, 3))

    def _columns(
        self, frames: TensorDict, slot: Tensor, hands: dict[keys.Side, HandSpec]
    ) -> dict[str, Tensor]:
        def own(name: str) -> Tensor:
            return gather_own(frames[name].float(), slot.clamp_min(0))

        tips = list(keys.TIP_KEYPOINTS)
        mapped = [[k for _, k in hands[s].keypoint_links] for s in keys.SIDES]
        pick = torch.tensor(mapped)
        pick = pick[None, :, :, None].expand(frames.shape[0], -1, -1, 3)
        keypoints = frames["keypoints"].float()
        keypoint_vel = frames["keypoint_linvel"].float()
        per_hand = (
            *("joint_pos", "joint_vel", "wrist_pos", "wrist_quat"),
            *("wrist_linvel", "wrist_angvel", "tip_dist"),
        )
        objects = ("object_pos", "object_quat", "object_linvel", "object_angvel")
        return {
            **{name: frames[name].float() for name in per_hand},
            "tip_pos": keypoints[:, :, tips],
            "tip_linvel": keypoint_vel[:, :, tips],
            "link_pos": torch.gather(keypoints, 2, pick),
            "link_linvel": torch.gather(keypoint_vel, 2, pick),
            "own_pos": own("object_pos"),
            "own_quat": own("object_quat"),
            "own_linvel": own("object_linvel"),
            "own_angvel": own("object_angvel"),
            **{name: frames[name].float() for name in objects},
        }

    def _pack(self, columns: dict[str, Tensor]) -> Tensor:
        offset, flat = 0, []
        for name, values in columns.items():
            shape = tuple(values.shape[1:])
            width = math.prod(shape)
            self._fields[name] = slice(offset, offset + width), shape
            flat.append(values.reshape(len(values), width))
            offset += width
        return torch.cat(flat, -1).contiguous()


def gather_own(values: Tensor, slot: Tensor) -> Tensor:
    """Pick each hand's own object: (N, O, C) by slots (N, 2) to (N, 2, C)."""
    index = slot.unsqueeze(-1).expand(-1, -1, values.shape[-1])
    return torch.gather(values, 1, index)


def stack_hands(hands: dict[keys.Side, HandSpec], name: str) -> Tensor:
    """Numbers of both hands' specs, left first, (2, ...)."""
    values = [torch.as_tensor(getattr(hands[side], name)) for side in keys.SIDES]
    return torch.stack(values).float()


def _pack_future(columns: dict[str, Tensor]) -> Tensor:
    """What the future window reads, side by side, (F, 2 * 45)."""
    names = ("own_pos", "own_linvel", "own_angvel", "wrist_pos")
    vectors = torch.stack([columns[n] for n in names], -2)
    vectors = torch.cat([vectors, columns["tip_pos"]], -2)
    quats = torch.stack([columns["own_quat"], columns["wrist_quat"]], -2)
    rotations = quat_to_matrix(quats).mT
    return torch.cat([vectors.flatten(2), rotations.flatten(2)], -1).flatten(1)
