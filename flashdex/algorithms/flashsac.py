"""FlashSAC on the tracking environment: packed replay around the agent."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex import keys
from flashdex.algorithms.agent import FlashSACAgent
from flashdex.algorithms.base import snapshot
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.hand_groups import HandGroups
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.assembly import Assembly
from flashdex.modules.layers import restore_generator
from flashdex.replay.buffer import STAGES, HostBuffer, RowBuffer, check_pinning
from flashdex.replay.codec import RowCodec, RowPatch, finite_rows
from flashdex.replay.nstep import NStepAssembler


class ReplayLearner:
    """Counters, replay and state of an off-policy learner.

    Subclasses make the agent, act, pack rows and sample them; see
    `flashdex.algorithms.base.Learner`. A vector step and an update never make the host
    wait for the device.

    Args:
        config: algorithm part of the recipe.
        agent: what learns; its device is that of the learner.
        generator: of the agent's noise; it also draws the replay samples, unless those
            are drawn elsewhere, see `flashdex.replay.buffer.make_buffer`.
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


class FlashSACLearner(ReplayLearner):
    """The paper's learner; see `flashdex.algorithms.base.Learner` for its contract.

    Args:
        config: algorithm part of the recipe.
        transforms: observation transforms in data-flow order.
        bank: reference frames, for the packed replay rows.
        example: one compact state, batch (N,), that fixes the network sizes.
        total_updates: horizon of the learning-rate schedule.
        seed: of networks, exploration and replay.
        device: where everything lives; ``bank`` and ``example`` are there already.
    """

    def __init__(
        self,
        config: AlgoConfig,
        transforms: list[Transform],
        bank: ReferenceBank,
        example: TensorDictBase,
        *,
        total_updates: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.bank = bank
        self.groups = HandGroups.of(bank, unified=config.groups == "unified")
        self.transforms = [t.to(device) for t in transforms]
        generator = torch.Generator(device).manual_seed(seed)
        torch.manual_seed(seed)
        self.show = Assembly(self.transforms, compile=config.compile)
        self.show_rows = Assembly(
            [t.clone() for t in self.transforms], compile=config.compile
        )
        shown = Assembly(self.transforms)(example)
        future = shown.get(keys.FUTURE, None)
        agent = FlashSACAgent(
            config,
            observation_dim=shown[keys.OBSERVATION].shape[-1],
            future_shape=None if future is None else tuple(future.shape[1:]),
            action_dim=self.groups.action_dim,
            groups=self.groups.names,
            num_envs=example.batch_size[0],
            total_updates=total_updates,
            generator=generator,
            deterministic_key=keys.ATTEMPT,
        )
        super().__init__(config, agent, generator, ones=("flags",))
        self.codec = RowCodec(bank)
        self._planned = 1  # updates until rows are added
        self._ahead: list[TensorDict] = []  # samples of those updates
        self.last_update: dict[str, Any] | None = None

    def due(self) -> int:
        """Updates to perform now; their samples will be assembled at once."""
        self._planned = super().due()
        return self._planned

    @torch.no_grad()
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """Actions of both hands, (N, 2, J).

        Attempt worlds act deterministically. Before the buffer is ready the other
        worlds act at random, uniformly, or by the untrained policy.

        Args:
            state: compact state, batch (N,), with the ``attempt`` flag.
            explore: False makes every world deterministic.
        """
        shown = self.show(state)
        shown.set(keys.ATTEMPT, state[keys.ATTEMPT])
        # A resumed learner may start with an empty buffer, but not without a policy.
        trained = self.ready or self.updates > 0
        by_policy = trained or self.config.warmup == "policy"
        kind = ExplorationType.RANDOM if by_policy else ExplorationType.DETERMINISTIC
        with set_exploration_type(kind if explore else ExplorationType.DETERMINISTIC):
            action = self.groups.join(self.agent.policy(shown))
        if by_policy or not explore:
            return action
        chance = torch.rand(
            action.shape, generator=self.generator, device=action.device
        )
        chance = 2 * chance - 1
        return torch.where(state[keys.ATTEMPT].unsqueeze(-1), action, chance)

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

        Rows that are not finite are replaced and counted: one in a thousand samples
        would be enough to lose the networks.
        """
        active = self.bank.hand_active[state[keys.MOTION].squeeze(-1)]
        finite = reward.isfinite()
        self.agent.normalizer.update(
            self.groups.rewards(torch.where(finite, reward, 0.0)),
            done,
            self.groups.mask(active & finite),
        )
        row = self.nstep.push(
            state.select(*keys.STATE),
            action,
            reward,
            next_state.select(*keys.STATE),
            terminated,
            done,
        )
        if row is not None:
            packed = self.codec.pack(row)
            # half precision overflows where float32 does not
            fits = packed["state"].isfinite() & packed["next_state"].isfinite()
            self._store(packed, finite_rows(row) & fits.all(-1))

    def sample(self, count: int = 1) -> list[TensorDict]:
        """Assembled replay samples: what the loss reads, batch (B,) each."""
        size = self.config.batch_size
        state, transition = self.codec.unpack(self.buffer.draw(count))
        shown = self.show_rows(state)
        wanted = [keys.OBSERVATION, keys.GROUP_MASK]
        if shown.get(keys.FUTURE, None) is not None:
            wanted.append(keys.FUTURE)
        now, after = shown.select(*wanted).split(count * size)
        after = after.set(keys.TERMINATED, transition[keys.TERMINATED])
        batch = now.set("next", after).set(keys.STEPS, transition[keys.STEPS])
        batch.set(keys.GROUP_MASK, self.groups.mask(batch[keys.GROUP_MASK]))
        reward = self.groups.rewards(transition[keys.REWARD])
        actions = self.groups.actions(transition[keys.ACTION])
        for i, group in enumerate(self.groups.names):
            batch.set((group, keys.ACTION), actions[i])
            batch.set(("next", group, keys.REWARD), reward[:, i : i + 1])
        return list(batch.split(size))

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
        """Perform an update again on the batch and with the draws it had.

        Args:
            update: ``last_update`` of the learner that performed it.
        """
        self.last_update = update
        restore_generator(self.generator, update["generator"])
        batch = TensorDict(update["batch"], batch_size=[update["batch_size"]])
        return self.agent.update(batch.to(self.device))


NEXT_OBSERVATION = "next_observation"


class GymLearner(ReplayLearner):
    """FlashSAC for one agent; see `flashdex.algorithms.base.Learner`.

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


def make_buffer(
    config: AlgoConfig, *, device: torch.device, generator: torch.Generator, seed: int
) -> RowBuffer:
    """The replay buffer of a recipe.

    Args:
        config: algorithm part of the recipe.
        device: of the learner.
        generator: of the learner, on its device; it draws the samples as long as they
            are drawn there, one after the other.
        seed: of another one otherwise.

    Raises:
        FlashdexError: pinned memory without a CUDA device, or it cannot be had.
    """
    sizes = {"batch_size": config.batch_size, "device": device}
    if config.replay in ("auto", "device"):
        return RowBuffer(config.buffer_size, generator=generator, **sizes)
    pinned = config.replay == "pinned"
    if pinned:
        check_pinning(device)
    if device.type != "cpu" or config.prefetch:
        generator = torch.Generator().manual_seed(seed)
    return HostBuffer(
        config.buffer_size,
        generator=generator,
        prefetch=config.prefetch,
        stages=STAGES if pinned else 0,
        pinned=pinned,
        **sizes,
    )
