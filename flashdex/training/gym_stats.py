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
        self.add_ends(done, terminated)
        if not done.any():
            return
        finished = {"episode/return": self._returns, "episode/length": self._lengths}
        sums = [value[done].double().sum() for value in finished.values()]
        self.add(list(finished), torch.stack(sums), done.sum())
        for value in finished.values():
            value[done] = 0
