"""FlashSAC on plain observations and actions: replay around the agent."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex import keys
from flashdex.recipe import AlgoConfig
from flashdex.training.agent import FlashSACAgent
from flashdex.training.guard import finite_rows
from flashdex.training.replay_learner import ReplayLearner

NEXT_OBSERVATION = "next_observation"


class GymLearner(ReplayLearner):
    """FlashSAC for one agent; see `flashdex.training.learner.Learner`.

    A state is a TensorDict (N,) with the ``observation`` (N, D); actions are (N, A) in
    [-1, 1] and rewards (N, 1).

    Args:
        config: algorithm part of the recipe.
        observation_dim: D.
        action_dim: A.
        num_envs: worlds N that are collected from.
        total_updates: horizon of the learning-rate schedule.
        seed: of networks, exploration and replay.
        device: where everything lives; states are there already.
    """

    def __init__(
        self,
        config: AlgoConfig,
        *,
        observation_dim: int,
        action_dim: int,
        num_envs: int,
        total_updates: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        generator = torch.Generator(device).manual_seed(seed)
        torch.manual_seed(seed)  # initial weights are drawn from the global stream
        agent = FlashSACAgent(
            config,
            observation_dim=observation_dim,
            action_dim=action_dim,
            num_envs=num_envs,
            total_updates=total_updates,
            generator=generator,
        )
        super().__init__(config, agent, generator, ones=(keys.TERMINATED, keys.STEPS))

    @torch.no_grad()
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """Actions, (N, A).

        Args:
            state: holds the observation, (N, D).
            explore: with noise; before there are rows to learn from, at random.
        """
        # A resumed learner may start with an empty buffer, but not without a policy.
        trained = self.ready or self.updates > 0 or self.config.warmup == "policy"
        if explore and not trained:
            shape = (state.batch_size[0], self.agent.actor.action_dim)
            chance = torch.rand(shape, generator=self.generator, device=self.device)
            return 2 * chance - 1
        kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
        with set_exploration_type(kind):
            return self.agent.policy(state.copy())[keys.ACTION]

    def remember(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Update the reward statistics and store what the n-step window yields.

        Rows that are not finite are replaced and counted.
        """
        finite = reward.isfinite()
        clean = torch.where(finite, reward, 0.0)
        self.agent.normalizer.update(clean, done, finite)
        row = self.nstep.push(state, action, reward, next_state, terminated, done)
        if row is not None:
            self._store(self._pack(row), finite_rows(row))

    def _pack(self, row: TensorDict) -> TensorDict:
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
        return TensorDict(flat, batch_size=row.batch_size)

    def sample(self) -> TensorDict:
        """A replay sample as the loss reads it, batch (B,)."""
        row = self.buffer.draw()
        return TensorDict(
            {
                keys.OBSERVATION: row[keys.OBSERVATION],
                keys.ACTION: row[keys.ACTION],
                keys.STEPS: row[keys.STEPS],
                "next": {
                    keys.OBSERVATION: row[NEXT_OBSERVATION],
                    keys.REWARD: row[keys.REWARD],
                    keys.TERMINATED: row[keys.TERMINATED],
                },
            },
            batch_size=row.batch_size,
        )

    def update(self) -> TensorDict:
        """One FlashSAC update on a fresh sample; returns its metrics."""
        return self.agent.update(self.sample())
