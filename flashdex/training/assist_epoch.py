"""Means over one assist epoch, as the gates of the schedule want them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from flashdex.envs.judge import Outcome
    from flashdex.envs.tracking import TrackingEnv

_TASK = ("object_points", "object_pose")
_IMITATION = ("wrist_pos", "wrist_rot", "fingertip_pos")
_CLONING = ("behaviour_cloning",)


class AssistEpoch:
    """Collects what decides whether the assist may fade.

    Only assisted worlds count: attempt worlds have no assist, so their failures say
    nothing about it. Hands without a part in the motion are left out.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._sums: dict[str, float] = {}
        self._count = 0.0
        self._ended = self._failed = 0

    def step(
        self,
        env: TrackingEnv,
        outcome: Outcome,
        done: Tensor,
        terminated: Tensor,
        vector_steps: int,
    ) -> None:
        """Take in one vector step of ``env``; at the end of an epoch let it fade.

        Args:
            env: its assist may be None; then nothing happens.
            outcome: rewards and masks of the step.
            done: (N, 1) bool.
            terminated: (N, 1) bool.
            vector_steps: of the run, this one included.
        """
        if env.assist is None:
            return
        self.add(outcome, ~env.attempt, done, terminated)
        ends = vector_steps % env.assist.config.epoch_steps == 0
        if ends and env.assist.end_epoch(**self.pop()):
            env.redraw_assist()

    def add(
        self, outcome: Outcome, assisted: Tensor, done: Tensor, terminated: Tensor
    ) -> None:
        """Take in one judged vector step.

        Args:
            outcome: rewards and masks of the step.
            assisted: worlds that count, (N,) bool.
            done: (N, 1) bool.
            terminated: (N, 1) bool.
        """
        counts = outcome.active & assisted.unsqueeze(-1)
        self._count += float(counts.sum())
        for name, value in outcome.terms.items():
            total = torch.where(counts, torch.nan_to_num(value), 0.0).sum()
            self._sums[name] = self._sums.get(name, 0.0) + float(total)
        self._ended += int((done.squeeze(-1) & assisted).sum())
        self._failed += int((terminated.squeeze(-1) & assisted).sum())

    def pop(self) -> dict[str, float]:
        """Means since the last call, each 0..1: arguments of ``end_epoch``."""

        def mean(names: tuple[str, ...]) -> float:
            found = [self._sums[n] for n in names if n in self._sums]
            count = len(found) * self._count
            return sum(found) / count if count else 0.0

        out = {
            "task": mean(_TASK[:1]) or mean(_TASK[1:]),
            "imitation": mean(_IMITATION),
            "cloning": mean(_CLONING),
            "completion": 1.0 - self._failed / self._ended if self._ended else 1.0,
        }
        self._clear()
        return out

    def state_dict(self) -> dict[str, Any]:
        """Sums of the open epoch."""
        return {
            "sums": dict(self._sums),
            "count": self._count,
            "ended": self._ended,
            "failed": self._failed,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self._sums, self._count = dict(state["sums"]), state["count"]
        self._ended, self._failed = state["ended"], state["failed"]
