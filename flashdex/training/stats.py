"""Running means between two log records."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys

if TYPE_CHECKING:
    from flashdex.envs.judge import Outcome


class RunningStats:
    """Collects means of rewards, errors, episode ends, losses and phase times."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._sums: dict[str, float | Tensor] = defaultdict(float)
        self._counts: dict[str, float | Tensor] = defaultdict(float)
        self._seconds: dict[str, float] = defaultdict(float)
        self._calls: dict[str, int] = defaultdict(int)
        self._ends = {"terminated": 0, "truncated": 0}
        self._causes: dict[str, int] = defaultdict(int)
        self._steps = 0

    @contextmanager
    def time(self, phase: str) -> Iterator[None]:
        """Add the time spent inside to ``perf/ms_<phase>``."""
        start = time.perf_counter()
        yield
        self._seconds[phase] += time.perf_counter() - start
        self._calls[phase] += 1

    def add_step(self, outcome: Outcome, done: Tensor, terminated: Tensor) -> None:
        """Take in one judged vector step.

        Args:
            outcome: rewards and errors.
            done: (N, 1) bool.
            terminated: (N, 1) bool.
        """
        self._steps += 1
        active = outcome.active
        values = {f"reward/{{side}}/{k}": v for k, v in outcome.terms.items()}
        values["reward/{side}/total"] = outcome.reward
        values["error/{side}/object_pos_mm"] = outcome.object_pos_error * 1e3
        degrees = torch.rad2deg(outcome.object_rot_error)
        values["error/{side}/object_rot_deg"] = degrees
        count = active.float().sum(0)
        for name, value in values.items():
            total = torch.where(active, torch.nan_to_num(value), 0.0).sum(0)
            for i, side in enumerate(keys.SIDES):
                key = name.format(side=side)
                self._sums[key] = self._sums[key] + total[i]
                self._counts[key] = self._counts[key] + count[i]
        failed = int(terminated.sum())
        ended = int(done.sum())
        self._ends["terminated"] += failed
        self._ends["truncated"] += ended - failed
        for name, cause in outcome.causes.items():
            self._causes[name] += int(cause.any(-1).sum())

    def add_update(self, metrics: TensorDictBase) -> None:
        """Take in the metrics of one update."""
        for key, value in metrics.items(True, True):
            full = "loss/" + ("/".join(key) if isinstance(key, tuple) else key)
            self._sums[full] = self._sums[full] + value.detach().float().mean()
            self._counts[full] = self._counts[full] + 1

    def pop(self, seconds: float, num_envs: int) -> dict[str, float]:
        """Means since the last call, and forget them.

        Args:
            seconds: time since the last call.
            num_envs: worlds of a vector step.
        """
        out = {
            key: float(total) / max(float(self._counts[key]), 1e-9)
            for key, total in self._sums.items()
        }
        ends = sum(self._ends.values())
        out["episode/ends"] = float(ends)
        out["episode/completed"] = self._ends["truncated"] / ends if ends else 0.0
        for name, count in self._causes.items():
            out[f"episode/{name}"] = count / ends if ends else 0.0
        out["perf/env_steps_per_s"] = self._steps * num_envs / seconds
        for phase, spent in self._seconds.items():
            out[f"perf/ms_{phase}"] = 1e3 * spent / max(self._calls[phase], 1)
        self._clear()
        return out
