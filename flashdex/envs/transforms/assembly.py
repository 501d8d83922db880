"""From the compact state to the observation: context, the recipe's blocks, one row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.envs.mdp.term import terms_of
from flashdex.envs.reference import ReferenceBank, gather_own
from flashdex.envs.transforms.base import BlockContext, StateTransform, make_block
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec

OUTPUTS = (keys.OBSERVATION, keys.FUTURE, keys.GROUP_MASK)
_INTERMEDIATES = (keys.KIN, keys.REF, keys.OWN, keys.BLOCKS)

_KIN_FIELDS = (
    *("wrist_pos", "wrist_quat", "wrist_linvel", "wrist_angvel"),
    *("link_pos", "link_quat", "link_linvel", "tip_pos", "tip_center", "tip_linvel"),
)
_REF_FIELDS = (
    *("link_pos", "link_linvel", "tip_pos", "tip_linvel"),
    *("own_pos", "own_quat"),
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


class ConcatBlocks(StateTransform):
    """Puts the blocks that are there side by side into ``observation``.

    They stand in the order of their transforms; all intermediates are dropped.

    Args:
        clip: bound on every entry; a diverged world must not poison the statistics.
    """

    def __init__(self, *, clip: float = 100.0) -> None:
        super().__init__(in_keys=[keys.BLOCKS], out_keys=[keys.OBSERVATION])
        self.clip = clip

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Concatenate, and replace what is not finite by zero."""
        blocks = torch.cat(list(td[keys.BLOCKS].values()), -1)
        blocks = torch.nan_to_num(blocks, nan=0.0).clamp(-self.clip, self.clip)
        return {keys.OBSERVATION: blocks}

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        td = super()._call(next_tensordict)
        return td.exclude(*_INTERMEDIATES, inplace=True)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> Composite:
        """Declare the observation and forget the intermediates."""
        spec = super().transform_observation_spec(observation_spec)
        for key in set(_INTERMEDIATES) & set(spec.keys()):
            del spec[key]
        return spec


def make_transforms(
    # ``env.transforms`` of the recipe: name to options, null = left out
    mapping: Mapping[str, Mapping[str, Any] | None],
    bank: ReferenceBank,  # reference frames and object tables
    hands: dict[keys.Side, HandSpec],  # hand specs by side
    *,
    reference_offset: int,  # ``env.reference_offset`` of the recipe
) -> list[Transform]:
    """Build the observation transforms of a recipe in data-flow order.

    Returns:
        Context, named blocks, concatenation. Clone them (``Transform.clone``) before
        handing them to a second container; buffers stay shared.
    """
    kinematics = HandKinematics(hands)
    context = TrackingContext(bank, kinematics, reference_offset=reference_offset)
    blocks = [
        make_block(term, BlockContext(name, bank, hands, reference_offset), options)
        for name, (term, options) in terms_of("transforms", mapping).items()
    ]
    return [context, *blocks, ConcatBlocks()]


def assemble(transforms: list[Transform], td: TensorDictBase) -> TensorDictBase:
    """Run transforms in order on a shallow copy of a compact state, batch (N,)."""
    td = td.copy()
    for transform in transforms:
        td = transform(td)
    return td


class Assembly:
    """What the networks read of a compact state, as one function of tensors.

    The same numbers as `assemble`, without TorchRL's steps from transform to transform
    and without the intermediate entries, so that a compiler can take it in one piece.

    Args:
        transforms: ``StateTransform`` in data-flow order; they are not changed.
        compile: make one graph of it: minutes at the first call and at the second size
            of the batch, fast from then on.
        backend: of the compiler.

    Raises:
        TypeError: a transform is no ``StateTransform``.
    """

    def __init__(
        self,
        transforms: Sequence[Transform],
        *,
        compile: bool = False,
        backend: str = "inductor",
    ) -> None:
        self.transforms: list[StateTransform] = []
        for transform in transforms:
            if not isinstance(transform, StateTransform):
                raise TypeError(f"{type(transform).__name__} is no StateTransform")
            self.transforms.append(transform)
        self._call: Any = self.pure
        if compile:
            self._call = torch.compile(self.pure, fullgraph=True, backend=backend)

    def __call__(self, state: TensorDictBase) -> TensorDict:
        """Observation, group mask and, where there is one, future window, (N,)."""
        shown = self._call({key: state.get(key) for key in keys.STATE})
        return TensorDict(shown, batch_size=state.batch_size)

    def pure(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The same on the plain tensors of ``keys.STATE``, (N, ...) each."""
        td = TensorDict(state, batch_size=state[keys.MOTION].shape[:1])
        for transform in self.transforms:
            for key, value in transform.assemble(td).items():
                td.set(key, value)
        found = {key: td.get(key, None) for key in OUTPUTS}
        return {key: value for key, value in found.items() if value is not None}
