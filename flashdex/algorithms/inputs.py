"""What actor-critics read of a state, and what replay keeps of it.

`HandRows` is for two hands that follow motions, `FlatRows` for one agent with a flat
observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.algorithms.base import TaskSpec
from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.assembly import Assembly
from flashdex.modules.future import FutureEncoder
from flashdex.replay.codec import RowCodec, finite_rows

UNIFIED = "both"


def make_encoder(
    config: AlgoConfig, shape: tuple[int, int] | None, ensemble: int
) -> FutureEncoder | None:
    """Encoder of a future window of ``shape`` (channels, frames), or None."""
    if shape is None:
        return None
    return FutureEncoder(
        shape[0],
        num_frames=shape[1],
        latent_dim=config.future_latent,
        widths=config.future_channels,
        ensemble=ensemble,
    )


@dataclass(frozen=True)
class HandGroups:
    """Groups of hands that share an actor-critic, and the way in and out of them.

    A hand that no motion of the collection uses belongs to no group: it needs no actor
    and no critic, and its action is zero.
    """

    names: tuple[str, ...]  # of the groups G, in tower order
    hands: tuple[int, ...]  # indices of those that act, [left, right] order
    action_dim: int  # actions A of one group

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


class HandRows:
    """Two hands: observations by transforms, packed rows, one group a hand or both."""

    ones = ("flags",)  # leaves that are 1 in a blank row
    samples_ahead = True  # a sample of several updates costs little more than one
    deterministic_key = keys.ATTEMPT

    def __init__(self, config: AlgoConfig, spec: TaskSpec) -> None:
        assert spec.bank is not None
        self.bank, self.codec = spec.bank, RowCodec(spec.bank)
        self.groups = HandGroups.of(self.bank, unified=config.groups == "unified")
        self.names: tuple[str, ...] | None = self.groups.names
        self.num_groups = len(self.groups.names)
        self.join, self.rewards = self.groups.join, self.groups.rewards
        self.action_dim = self.groups.action_dim
        self.transforms = [t.to(spec.device) for t in spec.transforms]
        # one compiled function a batch size
        self.assemble = Assembly(self.transforms, compile=config.compile)
        self.assemble_rows = Assembly(
            [t.clone() for t in self.transforms], compile=config.compile
        )
        seen = Assembly(self.transforms)(spec.example)
        self.observation_dim: int = seen[keys.OBSERVATION].shape[-1]
        future = seen.get(keys.FUTURE, None)
        self.future_shape: tuple[int, int] | None = None
        if future is not None:
            self.future_shape = (future.shape[1], future.shape[2])

    def observe(self, state: TensorDictBase) -> TensorDict:
        """What the policy reads of compact states, (N,)."""
        return self.assemble(state).set(keys.ATTEMPT, state[keys.ATTEMPT])

    def keep(self, state: TensorDictBase) -> TensorDictBase:
        """Entries of a state that rows need."""
        return state.select(*keys.STATE)

    def mask(self, state: TensorDictBase, finite: Tensor) -> Tensor:
        """Whose rewards count for the statistics, (N, G) bool."""
        active = self.bank.hand_active[state[keys.MOTION].squeeze(-1)]
        return self.groups.mask(active & finite)

    def pack(self, row: TensorDict) -> tuple[TensorDict, Tensor]:
        """Rows as they are stored, (N,), and which of them are sound, (N,) bool."""
        packed = self.codec.pack(row)
        # half precision overflows where float32 does not
        fits = packed["state"].isfinite() & packed["next_state"].isfinite()
        return packed, finite_rows(row) & fits.all(-1)

    def unpack(self, rows: TensorDictBase) -> TensorDict:
        """Stored rows as the loss reads them, (B,)."""
        state, transition = self.codec.unpack(rows)
        seen = self.assemble_rows(state)
        wanted = [keys.OBSERVATION, keys.GROUP_MASK]
        if self.future_shape is not None:
            wanted.append(keys.FUTURE)
        now, after = seen.select(*wanted).split(len(rows))
        after = after.set(keys.TERMINATED, transition[keys.TERMINATED])
        batch = now.set("next", after).set(keys.STEPS, transition[keys.STEPS])
        batch.set(keys.GROUP_MASK, self.groups.mask(batch[keys.GROUP_MASK]))
        reward = self.groups.rewards(transition[keys.REWARD])
        actions = self.groups.actions(transition[keys.ACTION])
        for i, group in enumerate(self.groups.names):
            batch.set((group, keys.ACTION), actions[i])
            batch.set(("next", group, keys.REWARD), reward[:, i : i + 1])
        return batch


NEXT_OBSERVATION = "next_observation"


class FlatRows:
    """One agent: the ``observation`` (N, D) as it is, rows of float32."""

    ones = (keys.TERMINATED, keys.STEPS)
    samples_ahead = False
    deterministic_key = None
    names = None
    num_groups = 1
    future_shape = None

    def __init__(self, config: AlgoConfig, spec: TaskSpec) -> None:
        self.observation_dim: int = spec.example[keys.OBSERVATION].shape[-1]
        self.action_dim = spec.action_dim

    def observe(self, state: TensorDictBase) -> TensorDict:
        """What the policy reads, (N,)."""
        return cast(TensorDict, state.select(keys.OBSERVATION))

    def join(self, td: TensorDictBase) -> Tensor:
        """Actions, (N, A)."""
        return td[keys.ACTION]

    keep = observe

    def rewards(self, reward: Tensor) -> Tensor:
        """Rewards, (N, 1)."""
        return reward

    def mask(self, state: TensorDictBase, finite: Tensor) -> Tensor:
        """Which rewards count for the statistics, (N, 1) bool."""
        return finite

    def pack(self, row: TensorDict) -> tuple[TensorDict, Tensor]:
        """Rows as they are stored, (N,), and which of them are sound, (N,) bool."""
        after = row["next_state", keys.OBSERVATION]
        flat = {
            keys.OBSERVATION: row["state", keys.OBSERVATION],
            # after a true termination it counts for nothing, but BatchNorm reads it
            NEXT_OBSERVATION: torch.where(after.isfinite(), after, 0.0),
            keys.ACTION: row["action"],
            keys.REWARD: row["reward"],
            keys.TERMINATED: row["terminated"],
            keys.STEPS: row["steps"].to(torch.int16),
        }
        return TensorDict(flat, batch_size=row.batch_size), finite_rows(row)

    def unpack(self, rows: TensorDictBase) -> TensorDict:
        """Stored rows as the loss reads them, (B,)."""
        after = {
            keys.OBSERVATION: rows[NEXT_OBSERVATION],
            keys.REWARD: rows[keys.REWARD],
            keys.TERMINATED: rows[keys.TERMINATED],
        }
        now: dict[str, Any] = {
            key: rows[key] for key in (keys.OBSERVATION, keys.ACTION, keys.STEPS)
        }
        return TensorDict({**now, "next": after}, batch_size=rows.batch_size)
