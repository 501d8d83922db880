"""What the training loop asks of an algorithm."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

if TYPE_CHECKING:
    pass


class Learner(Protocol):
    """Acts, remembers and learns; knows states and actions, but no simulator.

    Attributes:
        device: where it acts and learns.
        is_off_policy: it may learn between acting and remembering the outcome; an
            on-policy learner must not change before the rollout is complete.
    """

    device: torch.device
    is_off_policy: bool

    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """Actions of both hands, (N, 2, J); attempt worlds act deterministically.

        Args:
            state: compact state, batch (N,), with the ``attempt`` flag.
            explore: False makes every world deterministic.
        """
        ...

    def remember(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Take in one vector step.

        Args:
            state: compact state before the step, batch (N,).
            action: (N, 2, J).
            reward: per hand, (N, 2).
            next_state: compact state after the step, before any reset.
            terminated: (N, 1) bool.
            done: (N, 1) bool.
        """
        ...

    def due(self) -> int:
        """Updates to perform now; asked once after every vector step."""
        ...

    def update(self) -> TensorDict:
        """One update; returns its metrics, with the same keys every time."""
        ...

    @property
    def updates(self) -> int:
        """Updates performed so far."""
        ...

    @property
    def num_rows(self) -> int:
        """Transitions at hand to learn from."""
        ...

    def forget_episodes(self) -> None:
        """Drop what belongs to unfinished episodes: after a resume they are gone."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs, tensors and plain values only."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        ...


def snapshot(state: Any) -> Any:
    """Copy of a nested state on the CPU that shares no memory with the original.

    Args:
        state: tensors and plain values in dicts, lists and tuples.
    """
    if isinstance(state, Tensor):
        return state.detach().to("cpu", copy=True)
    if isinstance(state, dict):
        out = copy.copy(state)  # keeps the version notes of a module's state
        out.update({key: snapshot(value) for key, value in state.items()})
        return out
    if isinstance(state, list | tuple):
        return type(state)(snapshot(value) for value in state)
    return state
