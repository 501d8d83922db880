"""n-step windows over a vector environment, cut at the first episode end."""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class NStepAssembler:
    """Turns consecutive vector steps into rows of windows of at most ``n_step`` steps.

    Each push yields one row per world, for the step n - 1 pushes ago: the discounted
    sum of rewards up to the first episode end in the window, the state at the end of
    that window, its ``terminated`` flag and the true window length k, so that the
    bootstrap can be discounted by gamma^k.
    """

    def __init__(
        self, n_step: int, *, gamma: float, device: torch.device | None = None
    ) -> None:
        self.n_step, self.gamma, self.device = n_step, gamma, device
        self._steps: deque[TensorDict] = deque(maxlen=n_step)

    def push(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> TensorDict | None:
        """Take in one vector step; return N rows once n steps are at hand.

        Args:
            state: compact state before the step, batch (N,).
            action: (N, ...).
            reward: per group, (N, G).
            next_state: compact state after the step, before any reset, batch (N,).
            terminated: true failure, (N, 1) bool.
            done: failure or truncation, (N, 1) bool.

        Returns:
            (N,) of the arguments without ``done``, with ``steps``; or None.
        """
        step = {
            "state": state,
            "action": action,
            "reward": reward,
            "next_state": next_state,
            "terminated": terminated,
            "done": done,
        }
        self._steps.append(TensorDict(step, batch_size=state.batch_size))
        if len(self._steps) < self.n_step:
            return None
        return self._window()

    def _window(self) -> TensorDict:
        first = self._steps[0]
        reward = first["reward"].clone()
        alive = ~first["done"]
        steps = torch.ones_like(first["done"], dtype=torch.int64)
        last: Any = first.select("next_state", "terminated")
        for j in range(1, self.n_step):
            step = self._steps[j]
            reward = reward + self.gamma**j * step["reward"] * alive
            steps = steps + alive.long()
            # Worlds still running move the window's end to this step.
            end: Any = step.select("next_state", "terminated")
            last = torch.where(alive.squeeze(-1), end, last)
            alive = alive & ~step["done"]
        row = {
            "state": first["state"],
            "action": first["action"],
            "reward": reward,
            "next_state": last["next_state"],
            "terminated": last["terminated"],
            "steps": steps,
        }
        return TensorDict(row, batch_size=first.batch_size)

    def clear(self) -> None:
        """Forget the open window, as after a resume: its worlds are gone."""
        self._steps.clear()

    def state_dict(self) -> dict[str, Any]:
        """Steps of the open window."""
        return {"steps": [s.to_dict() for s in self._steps]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self._steps.clear()
        for step in state["steps"]:
            loaded = TensorDict(step, step["done"].shape[:1], device=self.device)
            self._steps.append(loaded)
