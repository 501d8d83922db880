"""Running means between two log records."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys

if TYPE_CHECKING:
    from flashdex.envs.mdp.step import StepResult

Names = tuple[str, ...]


class RunningStats:
    """Collects means of rewards, errors, episode ends, losses and phase times.

    What a step or an update adds stays on its device, many numbers in one tensor; the
    host waits for them once, when they are logged.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._tables: dict[Names, tuple[Tensor, Tensor]] = {}
        self._seconds: dict[str, float] = defaultdict(float)
        self._calls: dict[str, int] = defaultdict(int)
        self._ends: dict[Names, Tensor] = {}
        self._steps = 0

    @contextmanager
    def time(self, phase: str) -> Iterator[None]:
        """Add the time spent inside to ``perf/ms_<phase>``.

        On a GPU that is the time the host takes, which does not wait for the device.
        """
        start = time.perf_counter()
        yield
        self._seconds[phase] += time.perf_counter() - start
        self._calls[phase] += 1

    def add(self, names: Sequence[str], sums: Tensor, counts: Tensor) -> None:
        """Take in sums (K,), and over how many values each goes, (K,) or () for all.

        The K names must be the same at every call of their kind.
        """
        sums, counts = sums.double(), counts.double().expand(len(names))
        known = self._tables.get(tuple(names))
        if known is not None:
            sums, counts = known[0] + sums, known[1] + counts
        self._tables[tuple(names)] = sums, counts

    def add_step(self, result: StepResult, done: Tensor, terminated: Tensor) -> None:
        """Take in one scored vector step; flags are (N, 1) bool."""
        values = {f"reward/{{side}}/{k}": v for k, v in result.reward_terms.items()}
        values["reward/{side}/total"] = result.reward
        values["error/{side}/object_pos_mm"] = result.object_pos_error * 1e3
        degrees = torch.rad2deg(result.object_rot_error)
        values["error/{side}/object_rot_deg"] = degrees
        names = [name.format(side=side) for name in values for side in keys.SIDES]
        found = torch.nan_to_num(torch.stack(list(values.values())))  # (K, N, 2)
        active = result.active
        sums = torch.where(active, found, 0.0).sum(1)
        counts = active.sum(0).expand_as(sums)
        self.add(names, sums.flatten(), counts.flatten())
        self.add_ends(done, terminated, result.terminations)

    def add_ends(
        self, done: Tensor, terminated: Tensor, causes: dict[str, Tensor] | None = None
    ) -> None:
        """Count one vector step and the episodes that ended in it, (N, 1) bool.

        ``causes`` of the ends are (N, 2) bool each, by hand.
        """
        self._steps += 1
        causes = causes or {}
        ends = [done.sum(), terminated.sum()]
        ends += [cause.any(-1).sum() for cause in causes.values()]
        names, total = tuple(causes), torch.stack(ends)
        known = self._ends.get(names)
        self._ends[names] = total if known is None else known + total

    def add_update(self, metrics: TensorDictBase) -> None:
        """Take in the metrics of one update."""
        names, values = [], []
        for key, value in metrics.items(True, True):
            names.append("loss/" + ("/".join(key) if isinstance(key, tuple) else key))
            values.append(value.detach().double().mean())
        found = torch.stack(values)
        self.add(names, found, torch.ones_like(found))

    def pop(self, seconds: float, num_envs: int) -> dict[str, float]:
        """Means since the last call, ``seconds`` ago; waits for the device."""
        out = {"episode/ends": 0.0, "episode/completed": 0.0}
        for names, (sums, counts) in self._tables.items():
            means = (sums / counts.clamp_min(1e-9)).tolist()
            out.update(zip(names, means, strict=True))
        for names, ends in self._ends.items():
            ended, failed, *causes = ends.tolist()
            out["episode/ends"] = float(ended)
            out["episode/completed"] = (ended - failed) / ended if ended else 0.0
            for name, count in zip(names, causes, strict=True):
                out[f"episode/{name}"] = count / ended if ended else 0.0
        out["perf/env_steps_per_s"] = self._steps * num_envs / seconds
        for phase, spent in self._seconds.items():
            out[f"perf/ms_{phase}"] = 1e3 * spent / max(self._calls[phase], 1)
        self._clear()
        return out
