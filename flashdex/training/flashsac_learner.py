"""FlashSAC on the tracking environment: packed replay around the agent."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.compiled import Assembly
from flashdex.modules.layers import restore_generator
from flashdex.recipe import AlgoConfig
from flashdex.training.agent import FlashSACAgent
from flashdex.training.guard import finite_rows
from flashdex.training.hand_groups import HandGroups
from flashdex.training.replay_learner import ReplayLearner
from flashdex.training.rows import RowCodec


class FlashSACLearner(ReplayLearner):
    """The paper's learner; see `flashdex.training.learner.Learner` for its contract.

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
            quiet=keys.ATTEMPT,
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
