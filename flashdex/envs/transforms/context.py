"""What every block needs first: kinematics of the robot, reference, own objects."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.base import StateTransform
from flashdex.envs.transforms.features import gather_own
from flashdex.hands.kinematics import HandKinematics

_KIN_FIELDS = (
    "wrist_pos",
    "wrist_quat",
    "wrist_linvel",
    "wrist_angvel",
    "link_pos",
    "link_quat",
    "link_linvel",
    "tip_pos",
    "tip_center",
    "tip_linvel",
)
_REF_FIELDS = (
    "link_pos",
    "link_linvel",
    "tip_pos",
    "tip_linvel",
    "own_pos",
    "own_quat",
)


class TrackingContext(StateTransform):
    """Writes ``kin``, ``ref`` and each hand's own object next to the compact state.

    Args:
        bank: reference frames.
        kinematics: forward kinematics of both hands.
        reference_offset: 0 shows the frame the coming step is scored on (the paper's
            reading), 1 the one after it (the released code).
    """

    def __init__(
        self, bank: ReferenceBank, kinematics: HandKinematics, *, reference_offset: int
    ) -> None:
        out = [(keys.KIN, f) for f in _KIN_FIELDS] + [
            (keys.REF, f) for f in _REF_FIELDS
        ]
        own = [(keys.OWN, name) for name in ("pos", "quat", "vel", "row", "present")]
        state = [keys.JOINT_POS, keys.JOINT_VEL, keys.OBJECT_POSE, keys.OBJECT_VEL]
        super().__init__(
            in_keys=[*state, keys.MOTION, keys.FRAME],
            out_keys=[*out, *own, keys.GROUP_MASK],
        )
        self.bank = bank
        self.kinematics = kinematics
        self.reference_offset = reference_offset

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """See the class."""
        motion = td[keys.MOTION].squeeze(-1)
        frame = td[keys.FRAME].squeeze(-1) + self.reference_offset
        kin = self.kinematics(td[keys.JOINT_POS], td[keys.JOINT_VEL])
        ref = self.bank.at(motion, frame, _REF_FIELDS)
        slot = self.bank.hand_slot[motion]
        pose = gather_own(td[keys.OBJECT_POSE], slot)
        present = self.bank.has_object[motion].unsqueeze(-1)
        out: dict[NestedKey, Tensor] = {(keys.KIN, f): kin[f] for f in _KIN_FIELDS}
        out.update({(keys.REF, f): ref[f] for f in _REF_FIELDS})
        out[keys.OWN, "pos"] = pose[..., :3]
        out[keys.OWN, "quat"] = pose[..., 3:]
        out[keys.OWN, "vel"] = gather_own(td[keys.OBJECT_VEL], slot)
        out[keys.OWN, "row"] = self.bank.hand_object[motion]
        out[keys.OWN, "present"] = present
        out[keys.GROUP_MASK] = self.bank.hand_active[motion]
        return out


class Block(StateTransform):
    """A named part of the observation: features of the hands, side by side.

    Subclasses write ``features`` (N, 2, D); hands without a part in the motion and,
    where ``needs_object`` is set, hands without an object get zeros. A hand that no
    motion of the collection uses is left out.

    Args:
        name: key under ``blocks``.
        used_hands: indices of the hands to keep.
    """

    needs_object = False

    def __init__(self, name: str, used_hands: list[int]) -> None:
        super().__init__(
            in_keys=[keys.KIN, keys.REF, keys.OWN, keys.GROUP_MASK],
            out_keys=[(keys.BLOCKS, name)],
        )
        # a slice: a list as an index is copied to the device at every call
        self.name, self.hands = name, slice(used_hands[0], used_hands[-1] + 1)

    def features(self, td: TensorDictBase) -> Tensor:
        """Features of both hands, (N, 2, D)."""
        raise NotImplementedError

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Mask and flatten the features."""
        values = self.features(td)
        mask = td[keys.GROUP_MASK].unsqueeze(-1)
        if self.needs_object:
            mask = mask & td[keys.OWN, "present"]
        values = torch.where(mask, values, torch.zeros_like(values))
        return {(keys.BLOCKS, self.name): values[:, self.hands].flatten(1)}


class ConcatBlocks(StateTransform):
    """Puts the blocks side by side into ``observation`` and drops all intermediates.

    Args:
        names: blocks in order.
        clip: bound on every entry; a diverged world must not poison the statistics.
    """

    def __init__(self, names: list[str], *, clip: float = 100.0) -> None:
        super().__init__(
            in_keys=[(keys.BLOCKS, n) for n in names], out_keys=[keys.OBSERVATION]
        )
        self.names = names
        self.clip = clip

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Concatenate, and replace what is not finite by zero."""
        blocks = torch.cat([td[keys.BLOCKS, n] for n in self.names], -1)
        blocks = torch.nan_to_num(blocks, nan=0.0).clamp(-self.clip, self.clip)
        return {keys.OBSERVATION: blocks}

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        td = super()._call(next_tensordict)
        return td.exclude(keys.KIN, keys.REF, keys.OWN, keys.BLOCKS, inplace=True)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> Composite:
        """Declare the observation and forget the intermediates."""
        spec = super().transform_observation_spec(observation_spec)
        for key in {keys.KIN, keys.REF, keys.OWN, keys.BLOCKS} & set(spec.keys()):
            del spec[key]
        return spec
