"""A sampled batch as plain tensors: what the FlashSAC objectives read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


class FlashBatch(NamedTuple):
    """B transitions; observations hold s in the first B rows and s' in the last B."""

    observation: Tensor  # (2B, D)
    future: Tensor | None  # (2B, C, K)
    action: Tensor  # joint action of all groups, (B, G A)
    reward: Tensor  # scaled n-step reward, (G, B)
    discount: Tensor  # gamma^k with the true window length k, (B,)
    terminated: Tensor  # 1 where the window ends in a true termination, (B,)
    weight: Tensor | None  # 1 where a group takes part, (G, B); None is everywhere

    @property
    def size(self) -> int:
        """Number of transitions B."""
        return self.action.shape[0]

    def split(self) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """``observation, next_observation, future, next_future``."""
        size = self.size
        now, after = self.observation[:size], self.observation[size:]
        if self.future is None:
            return now, after, None, None
        return now, after, self.future[:size], self.future[size:]


def nested(group: str | None, key: NestedKey) -> NestedKey:
    """Key of a group's entry; None is the root."""
    if group is None:
        return key
    return (group, key) if isinstance(key, str) else (group, *key)


def read_pair(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Entry at t and at t + k, one after the other: (2B, ...)."""
    return torch.cat([tensordict.get(key), tensordict.get(nested("next", key))])


def read_windows(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Windows (B, C, K) at t and at t + k, (2B, C, K), each frame's channels adjacent.

    The encoders read frames before channels; one copy here spares one in each of them.
    """
    ends = tensordict.get(key), tensordict.get(nested("next", key))
    return torch.cat([end.mT for end in ends]).mT


def masked_mean(values: Tensor, weight: Tensor | None) -> Tensor:
    """Mean over the last axis of the entries of weight 1; zero if there are none."""
    if weight is None:
        return values.mean(-1)
    # select, not multiply: an entry that does not count may be anything
    chosen = torch.where(weight > 0, values, 0.0)
    return chosen.sum(-1) / weight.sum(-1).clamp_min(1.0)


def stack_groups(
    tensordict: TensorDictBase, groups: Sequence[str | None], key: NestedKey
) -> Tensor:
    """Entries of all groups side by side on the last axis, (B, sum of widths)."""
    entries = [tensordict.get(nested(group, key)) for group in groups]
    return entries[0] if len(entries) == 1 else torch.cat(entries, dim=-1)
