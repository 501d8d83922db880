"""Bases of the observation transforms: one pure ``assemble`` behind three doors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.envs.mdp.term import Term
from flashdex.envs.reference import ReferenceBank
from flashdex.geometry.rotation import quat_rotate_inverse
from flashdex.hands.spec import HandSpec

# Scales of method section 6 that bring speeds near one.
LINVEL_SCALE, ANGVEL_SCALE, JOINT_VEL_SCALE = 2.0, 0.25, 0.1


class StateTransform(Transform):
    """A pure function of the compact state, the same online and on replay samples.

    The environment calls ``_call`` and ``_reset``; the policy input and the replay
    sample go through ``forward``, which treats a ``next`` entry alike. All three end in
    ``assemble``, so what the policy saw and what the learner sees cannot drift apart.

    Subclasses set ``in_keys`` and ``out_keys`` and write ``assemble``.
    """

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Compute the entries of ``out_keys`` from a compact state of batch (N,)."""
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, value in self.assemble(next_tensordict).items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Assemble a policy input, or both ends of a replay sample."""
        self._call(tensordict)
        after = tensordict.get("next", None)
        if after is not None and after.get(keys.JOINT_POS, None) is not None:
            self._call(after)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> Composite:
        """Declare ``out_keys`` by running ``assemble`` on a zero state."""
        if not isinstance(observation_spec, Composite):
            msg = "the compact state is a Composite of its entries"
            raise TypeError(msg)
        zeros = observation_spec.zero()
        for key, value in self.assemble(zeros).items():
            observation_spec[key] = Unbounded(
                shape=value.shape, dtype=value.dtype, device=observation_spec.device
            )
        return observation_spec


@dataclass(frozen=True)
class BlockContext:
    """What observation transforms are made from."""

    name: str  # of the block in the recipe
    bank: ReferenceBank  # reference frames and object tables
    hands: dict[keys.Side, HandSpec]  # hand specs by side
    reference_offset: int  # ``env.reference_offset`` of the recipe

    @property
    def used_hands(self) -> slice:
        """Hands that any motion of the collection uses."""
        # a slice: a list as an index is copied to the device at every call
        return slice(self.bank.used_hands[0], self.bank.used_hands[-1] + 1)


class Block(StateTransform):
    """A named part of the observation: features of the hands, side by side.

    Subclasses write ``features`` (N, 2, D); hands without a part in the motion and,
    where ``needs_object`` is set, hands without an object get zeros. A hand that no
    motion of the collection uses is left out.
    """

    needs_object = False

    def __init__(self, context: BlockContext) -> None:
        super().__init__(
            in_keys=[keys.KIN, keys.REF, keys.OWN, keys.GROUP_MASK],
            out_keys=[(keys.BLOCKS, context.name)],
        )
        self.name, self.hands = context.name, context.used_hands

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


class FunctionBlock(Block):
    """A block whose features are those of a registered function."""

    def __init__(
        self, context: BlockContext, term: Term, options: dict[str, Any]
    ) -> None:
        super().__init__(context)
        self.needs_object = term.needs_object
        self._features = term.bind(context, options)

    def features(self, td: TensorDictBase) -> Tensor:
        """See the function."""
        return self._features(td)


def make_block(
    term: Term, context: BlockContext, options: dict[str, Any]
) -> StateTransform:
    """Build the transform of an observation that a recipe names."""
    if not isinstance(term.make, type):
        return FunctionBlock(context, term, options)
    block = term.make(context, **options)
    if term.needs_object:
        block.needs_object = True
    return block


def own_object(td: TensorDictBase, *names: str) -> list[Tensor]:
    """Fields of each hand's own object: pos, quat, vel, row or present."""
    return [td[keys.OWN, name] for name in names]


def to_wrist(quat: Tensor, vectors: Tensor) -> Tensor:
    """Rotate world vectors (N, 2, P, 3) into the wrist frames (N, 2, 4)."""
    return quat_rotate_inverse(quat.unsqueeze(-2), vectors)


def positive_quat(quat: Tensor) -> Tensor:
    """The same rotations with w >= 0, (..., 4)."""
    return torch.where(quat[..., :1] < 0, -quat, quat)
