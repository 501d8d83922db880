"""Running means between two log records of a run on a stock environment."""

from __future__ import annotations

import torch
from torch import Tensor

from flashdex.training.stats import RunningStats


class GymStats(RunningStats):
    """Adds returns and lengths of finished training episodes.

    Args:
        num_envs: worlds N.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__()
        self._returns = torch.zeros(num_envs, 1, dtype=torch.float64)
        self._lengths = torch.zeros(num_envs, 1, dtype=torch.int64)

    def add_rewards(self, reward: Tensor, terminated: Tensor, done: Tensor) -> None:
        """Take in one vector step.

        Args:
            reward: raw, (N, 1); those not finite count as 0.
            terminated: (N, 1) bool.
            done: terminated or truncated, (N, 1) bool.
        """
        self._steps += 1
        self._returns += torch.where(reward.isfinite(), reward, 0.0)
        self._lengths += 1
        ended, failed = int(done.sum()), int(terminated.sum())
        if not ended:
            return
        self._ends["terminated"] += failed
        self._ends["truncated"] += ended - failed
        finished = {"episode/return": self._returns, "episode/length": self._lengths}
        for key, value in finished.items():
            self._sums[key] += float(value[done].sum())
            self._counts[key] += ended
            value[done] = 0
