"""What FlashSAC learners share: an agent, n-step rows, and when to learn from them."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer

from flashdex.recipe import AlgoConfig
from flashdex.training.agent import FlashSACAgent
from flashdex.training.checkpoint import snapshot
from flashdex.training.nstep import NStepAssembler


class ReplayLearner:
    """Counters, replay and state of an off-policy learner.

    Subclasses make the agent, act, pack rows and sample them; see
    `flashdex.training.learner.Learner`.

    Args:
        config: algorithm part of the recipe.
        agent: what learns.
        generator: of the agent's noise; it also draws the replay samples.
    """

    is_off_policy = True

    def __init__(
        self, config: AlgoConfig, agent: FlashSACAgent, generator: torch.Generator
    ) -> None:
        self.config, self.agent, self.generator = config, agent, generator
        self.nstep = NStepAssembler(config.n_step, gamma=config.gamma)
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(config.buffer_size), generator=generator
        )
        self._debt = 0.0
        self.num_dropped = 0  # rows that were not finite

    @property
    def ready(self) -> bool:
        """Whether the replay buffer holds enough rows to learn from."""
        return len(self.buffer) >= self.config.min_buffer

    @property
    def updates(self) -> int:
        """Critic updates performed so far."""
        return self.agent.stepper.updates

    @property
    def num_rows(self) -> int:
        """Rows of the replay buffer."""
        return len(self.buffer)

    def due(self) -> int:
        """Updates to perform now; a fraction is carried to the next vector step."""
        if not self.ready:
            return 0
        self._debt += self.config.updates_per_step
        whole = int(self._debt)
        self._debt -= whole
        return whole

    def forget_episodes(self) -> None:
        """Drop the open n-step window and the running returns."""
        self.nstep.clear()
        self.agent.normalizer.clear_returns()

    def state_dict(self) -> dict[str, Any]:
        """A copy of agent, n-step tail and update debt; replay rows are no part of it.

        The generator is the agent's: it also draws the replay samples.
        """
        state = {
            "agent": self.agent.state_dict(),
            "nstep": self.nstep.state_dict(),
            "debt": self._debt,
            "dropped": self.num_dropped,
        }
        return snapshot(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a copy of ``state_dict``."""
        # Adam keeps the very tensors it is given: two learners would share them.
        state = snapshot(state)
        self.agent.load_state_dict(state["agent"])
        self.nstep.load_state_dict(state["nstep"])
        self._debt = state["debt"]
        self.num_dropped = state["dropped"]
