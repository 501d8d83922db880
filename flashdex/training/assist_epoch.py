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
    nothing about it. Hands without a part in the motion are left out. What a step adds
    stays on its device; the host waits for it once an epoch.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._names: tuple[str, ...] = ()
        # sums of the terms, then entries, ends and failures
        self._totals: Tensor | None = None

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
        terms = torch.nan_to_num(torch.stack(list(outcome.terms.values())))
        sums = torch.where(counts, terms, 0.0).sum((1, 2))
        numbers = [
            counts.sum(),
            (done.squeeze(-1) & assisted).sum(),
            (terminated.squeeze(-1) & assisted).sum(),
        ]
        total = torch.cat([sums.double(), torch.stack(numbers).double()])
        names = tuple(outcome.terms)
        if self._totals is not None and names == self._names:
            total = total + self._totals.to(total.device)  # a checkpoint's: on the CPU
        self._names, self._totals = names, total

    def _read(self) -> tuple[dict[str, float], float, int, int]:
        """Sums of the terms, entries, ends and failures."""
        if self._totals is None:
            return {}, 0.0, 0, 0
        *sums, count, ended, failed = self._totals.tolist()
        return dict(zip(self._names, sums, strict=True)), count, int(ended), int(failed)

    def pop(self) -> dict[str, float]:
        """Means since the last call, each 0..1: arguments of ``end_epoch``."""
        sums, number, ended, failed = self._read()

        def mean(names: tuple[str, ...]) -> float:
            found = [sums[n] for n in names if n in sums]
            count = len(found) * number
            return sum(found) / count if count else 0.0

        out = {
            "task": mean(_TASK[:1]) or mean(_TASK[1:]),
            "imitation": mean(_IMITATION),
            "cloning": mean(_CLONING),
            "completion": 1.0 - failed / ended if ended else 1.0,
        }
        self._clear()
        return out

    def state_dict(self) -> dict[str, Any]:
        """Sums of the open epoch."""
        sums, count, ended, failed = self._read()
        return {"sums": sums, "count": count, "ended": ended, "failed": failed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self._names = tuple(state["sums"])
        numbers = [state[name] for name in ("count", "ended", "failed")]
        values = [*state["sums"].values(), *numbers]
        self._totals = torch.tensor(values, dtype=torch.float64)
