"""How the two hands are divided among actor-critics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank

UNIFIED = "both"


@dataclass(frozen=True)
class HandGroups:
    """Groups of hands that share an actor-critic, and the way in and out of them.

    A hand that no motion of the collection uses belongs to no group: it needs no actor
    and no critic, and its action is zero.

    Attributes:
        names: of the groups G, in tower order.
        hands: indices of the hands that act, [left, right] order.
        action_dim: actions A of one group.
    """

    names: tuple[str, ...]
    hands: tuple[int, ...]
    action_dim: int

    @property
    def _range(self) -> slice:
        # by a slice: a list as an index is copied to the device each time
        return slice(self.hands[0], self.hands[-1] + 1)

    @classmethod
    def of(cls, bank: ReferenceBank, *, unified: bool) -> HandGroups:
        """Groups for the motions of ``bank``; one hand alone is never unified."""
        hands = tuple(bank.used_hands)
        if unified and len(hands) == 2:
            return cls((UNIFIED,), hands, 2 * bank.num_joints)
        return cls(tuple(keys.SIDES[i] for i in hands), hands, bank.num_joints)

    @property
    def is_unified(self) -> bool:
        """Whether one group drives both hands."""
        return self.names == (UNIFIED,)

    def join(self, td: TensorDictBase) -> Tensor:
        """Actions of all groups in ``td`` (N,) as one (N, 2, J)."""
        actions = torch.cat([td[group, keys.ACTION] for group in self.names], -1)
        actions = actions.unflatten(-1, (len(self.hands), -1))
        joint = actions.new_zeros(len(actions), 2, actions.shape[-1])
        joint[:, self._range] = actions
        return joint

    def actions(self, joint: Tensor) -> list[Tensor]:
        """Each group's part of the joint action (B, 2 J): G times (B, A)."""
        if self.is_unified:
            return [joint]
        both = joint.chunk(2, -1)
        return [both[i] for i in self.hands]

    def rewards(self, reward: Tensor) -> Tensor:
        """Rewards (B, 2) of the hands as rewards (B, G) of the groups."""
        if self.is_unified:
            return reward.sum(-1, keepdim=True)
        return reward[:, self._range]

    def mask(self, active: Tensor) -> Tensor:
        """Where a group takes part, (B, G) bool, from that of the hands (B, 2)."""
        if self.is_unified:
            return torch.ones_like(active[:, :1])
        return active[:, self._range]
