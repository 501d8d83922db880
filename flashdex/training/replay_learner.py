"""What FlashSAC learners share: an agent, n-step rows, and when to learn from them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex.modules.layers import restore_generator
from flashdex.recipe import AlgoConfig
from flashdex.training.agent import FlashSACAgent
from flashdex.training.checkpoint import snapshot
from flashdex.training.nstep import NStepAssembler
from flashdex.training.replay_store import make_buffer
from flashdex.training.row_patch import RowPatch


class ReplayLearner:
    """Counters, replay and state of an off-policy learner.

    Subclasses make the agent, act, pack rows and sample them; see
    `flashdex.training.learner.Learner`. A vector step and an update never make the host
    wait for the device.

    Args:
        config: algorithm part of the recipe.
        agent: what learns; its device is that of the learner.
        generator: of the agent's noise; it also draws the replay samples, unless those
            are drawn elsewhere, see `flashdex.training.replay_store.make_buffer`.
        ones: leaves of a row that are 1 in a blank one, see `RowPatch`.
    """

    is_off_policy = True

    def __init__(
        self,
        config: AlgoConfig,
        agent: FlashSACAgent,
        generator: torch.Generator,
        *,
        ones: Collection[str] = (),
    ) -> None:
        self.config, self.agent, self.generator = config, agent, generator
        self.device = agent.device
        self.nstep = NStepAssembler(
            config.n_step, gamma=config.gamma, device=self.device
        )
        self.buffer = make_buffer(
            config,
            device=self.device,
            generator=generator,
            seed=generator.initial_seed(),
        )
        self._patch = RowPatch(self.device, ones=ones)
        self._debt = 0.0

    @property
    def ready(self) -> bool:
        """Whether the replay buffer holds enough rows to learn from."""
        return self.num_rows >= self.config.min_buffer

    @property
    def num_dropped(self) -> int:
        """Rows that were not finite and gave way to others; waits for the device."""
        return self._patch.count

    @property
    def updates(self) -> int:
        """Critic updates performed so far."""
        return self.agent.stepper.updates

    @property
    def num_rows(self) -> int:
        """Rows of the replay buffer."""
        return self.buffer.num_rows

    def _store(self, rows: TensorDict, good: Tensor) -> None:
        """Store flat rows, (N,), of which only those of ``good``, (N,), are sound."""
        self.buffer.push(self._patch(rows, good))

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

        The generator is the agent's; one that only draws replay samples goes along.
        """
        sampler = self.buffer.generator
        is_own = sampler is not self.generator
        state = {
            "agent": self.agent.state_dict(),
            "nstep": self.nstep.state_dict(),
            "debt": self._debt,
            "dropped": self.num_dropped,
            "sampler": sampler.get_state() if is_own else None,
        }
        return snapshot(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a copy of ``state_dict``."""
        # Adam keeps the very tensors it is given: two learners would share them.
        state = snapshot(state)
        self.agent.load_state_dict(state["agent"])
        self.nstep.load_state_dict(state["nstep"])
        self._debt = state["debt"]
        self._patch.count = state["dropped"]
        sampler = state.get("sampler")
        if sampler is not None and self.buffer.generator is not self.generator:
            restore_generator(self.buffer.generator, sampler)
