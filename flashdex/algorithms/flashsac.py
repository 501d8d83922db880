"""FlashSAC as a learner: an agent, and replay around it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex.algorithms.agent import FlashSACAgent, make_networks, walk_update
from flashdex.algorithms.base import Learner, TaskSpec, register, snapshot
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.footprint import Footprint, Networks, PeakMeter, tensor_bytes
from flashdex.algorithms.inputs import FlatRows, HandRows
from flashdex.modules.layers import restore_generator
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.replay.buffer import STAGES, RowBuffer, check_pinning
from flashdex.replay.codec import RowPatch
from flashdex.replay.nstep import NStepAssembler


@register("flashsac")
class FlashSACLearner(Learner):
    """The paper's learner, on the tracking environment and on stock ones.

    A vector step and an update never make the host wait for the device.
    """

    tasks = ("retarget", "gym")
    immutable_keys = (
        *Learner.immutable_keys,
        "algo.head",
        "algo.critic_action",
        "algo.num_atoms",
        "algo.noise_clock",
    )
    has_replay = True
    is_off_policy = True

    def __init__(self, config: AlgoConfig, spec: TaskSpec) -> None:
        self.config, self.device = config, spec.device
        self.rows = (FlatRows if spec.bank is None else HandRows)(config, spec)
        self.generator = torch.Generator(self.device).manual_seed(spec.seed)
        torch.manual_seed(spec.seed)  # initial weights come from the global stream
        updates = math.ceil(spec.vector_steps * config.updates_per_step)
        self.agent = FlashSACAgent(
            config,
            self.rows,
            num_envs=spec.example.batch_size[0],
            total_updates=max(1, updates),
            generator=self.generator,
        )
        self.nstep = NStepAssembler(
            config.n_step, gamma=config.gamma, device=self.device
        )
        self.buffer = make_buffer(
            config, device=self.device, generator=self.generator, seed=spec.seed
        )
        self._patch = RowPatch(self.device, ones=self.rows.ones)
        self._debt = 0.0
        self._planned = 1  # updates until rows are added
        self._ahead: list[TensorDict] = []  # samples of those updates

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

    @torch.no_grad()
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """See ``Learner.act``; before the buffer is ready, by chance or untrained."""
        # A resumed learner may start with an empty buffer, but not without a policy.
        trained = self.ready or self.updates > 0
        by_policy = trained or self.config.warmup == "policy"
        kind = ExplorationType.RANDOM if by_policy else ExplorationType.DETERMINISTIC
        with set_exploration_type(kind if explore else ExplorationType.DETERMINISTIC):
            action = self.rows.join(self.agent.policy(self.rows.observe(state)))
        if by_policy or not explore:
            return action
        chance = torch.rand(action.shape, generator=self.generator, device=self.device)
        chance = 2 * chance - 1
        if self.rows.deterministic_key is None:
            return chance
        still = state[self.rows.deterministic_key].unsqueeze(-1)
        return torch.where(still, action, chance)

    def process_step(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Update the reward statistics and store what the n-step window yields.

        Rows that are not finite are replaced and counted: one in a thousand samples
        would be enough to lose the networks.
        """
        finite = reward.isfinite()
        self.agent.normalizer.update(
            self.rows.rewards(torch.where(finite, reward, 0.0)),
            done,
            self.rows.mask(state, finite),
        )
        state, next_state = self.rows.keep(state), self.rows.keep(next_state)
        row = self.nstep.push(state, action, reward, next_state, terminated, done)
        if row is not None:
            self.buffer.push(self._patch(*self.rows.pack(row)))

    def num_updates(self) -> int:
        """Updates to perform now; a fraction is carried to the next vector step."""
        whole = 0
        if self.ready:
            self._debt += self.config.updates_per_step
            whole = int(self._debt)
            self._debt -= whole
        if self.rows.samples_ahead:
            self._planned = whole
        return whole

    def sample(self, count: int = 1) -> list[TensorDict]:
        """Replay samples as the loss reads them, batch (B,) each."""
        batch = self.rows.unpack(self.buffer.draw(count))
        return list(batch.split(self.config.batch_size))

    def update(self) -> TensorDict:
        """One FlashSAC update; returns its metrics.

        The samples of all updates that are due are assembled at once, which costs
        little more than one: the time goes into many small operations.
        """
        if not self._ahead:
            self._ahead = self.sample(max(self._planned, 1))
            self._planned = 1
        batch = self._ahead.pop(0)
        self.last_update = {
            "batch": batch.to_dict(),
            "batch_size": len(batch),
            "generator": self.generator.get_state(),
        }
        return self.agent.update(batch)

    def redo(self, update: dict[str, Any]) -> TensorDict:
        """See ``Learner.redo``."""
        self.last_update = update
        restore_generator(self.generator, update["generator"])
        batch = TensorDict(update["batch"], batch_size=[update["batch_size"]])
        return self.agent.update(batch.to(self.device))

    def metrics(self) -> dict[str, float]:
        """What rewards are divided by."""
        return {"reward/scale": self.agent.normalizer.denominator().item()}

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

    def rehearse(self, config: AlgoConfig, state: TensorDictBase) -> Footprint:
        """See ``Learner.rehearse``; an observation is there while it is assembled."""
        peaks = []
        for count in (1, 2):
            with PeakMeter() as meter:
                batch = self.sample(count)[0]
            peaks.append(meter.peak)
        row, groups = batch[:1].to("meta"), self.rows.num_groups
        with torch.device("meta"):
            loss = FlashSACLoss(
                *make_networks(config, self.rows), groups=self.rows.names
            )

        def update(size: int) -> tuple[int, float]:
            batch = loss.read(row.expand(size))
            noise = torch.randn(groups, size, self.rows.action_dim, device="meta")
            peak, flops = walk_update(
                loss,
                batch,
                noise,
                lowered=config.bfloat16,
                actor_period=config.actor_period,
            )
            return peak + tensor_bytes([batch, noise]), flops

        ends = 2 * self.config.batch_size  # a row has two
        slope = -(-(peaks[1] - peaks[0]) // ends)
        return Footprint(Networks.of(loss), slope, lru_cache(update))

    @classmethod
    def conflicts(
        cls, config: AlgoConfig, budget: int, worlds: dict[str, int]
    ) -> list[str]:
        """See ``Learner.conflicts``; also between buffer, budget and worlds."""
        problems = super().conflicts(config, budget, worlds)
        if config.min_buffer > config.buffer_size:
            problems.append(
                f"algo.min_buffer: {config.min_buffer} rows never fit in "
                f"algo.buffer_size={config.buffer_size}; learning would not start"
            )
        if config.min_buffer >= budget > 1:
            problems.append(
                f"algo.min_buffer: {config.min_buffer} rows collected before learning "
                f"use up total_env_steps={budget}; give fewer rows or more steps"
            )
        # The newest n steps of every world have no complete return yet.
        ((key, num_envs),) = worlds.items()
        if config.buffer_size <= num_envs * config.n_step:
            problems.append(
                f"algo.buffer_size: {config.buffer_size} must exceed {key} x "
                f"algo.n_step = {num_envs * config.n_step}"
            )
        return problems


def make_buffer(
    config: AlgoConfig, *, device: torch.device, generator: torch.Generator, seed: int
) -> RowBuffer:
    """The replay buffer of a recipe for a learner on ``device``.

    Samples are drawn by the learner's own generator as long as they are drawn on its
    device, one after the other; otherwise by one of ``seed``.

    Raises:
        FlashdexError: pinned memory without a CUDA device, or it cannot be had.
    """
    pinned, on_host = config.replay == "pinned", config.replay in ("pinned", "cpu")
    prefetch = config.prefetch if on_host else 0
    if pinned:
        check_pinning(device)
    if on_host and (device.type != "cpu" or prefetch):
        generator = torch.Generator().manual_seed(seed)
    return RowBuffer(
        config.buffer_size,
        batch_size=config.batch_size,
        device=device,
        generator=generator,
        on_host=on_host,
        stages=STAGES if pinned else 0,
        prefetch=prefetch,
        pinned=pinned,
    )
