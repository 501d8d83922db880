"""Networks, loss and replay of a recipe, joined into one learner."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.base import assemble
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.exploration import NoiseRepetition
from flashdex.modules.future import FutureEncoder
from flashdex.modules.policy import FlashPolicy
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.stepper import FlashSACStepper
from flashdex.recipe import AlgoConfig
from flashdex.training.nstep import NStepAssembler
from flashdex.training.rows import RowCodec


class Learner:
    """Acts, remembers and learns; knows states and actions, but no simulator.

    Args:
        config: algorithm part of the recipe.
        transforms: observation transforms in data-flow order.
        bank: reference frames, for the packed replay rows.
        example: one compact state, batch (N,), that fixes the network sizes.
        total_updates: horizon of the learning-rate schedule.
        seed: of networks, exploration and replay.
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
    ) -> None:
        self.config, self.bank = config, bank
        # A hand that no motion uses needs no actor and no critic.
        self.hands = bank.used_hands
        self.unified = config.groups == "unified" and len(self.hands) == 2
        used = tuple(keys.SIDES[i] for i in self.hands)
        self.groups = ("both",) if self.unified else used
        self.transforms = transforms
        self.sample_transforms = [t.clone() for t in transforms]
        self.generator = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        num_envs = example.batch_size[0]
        shown = assemble(transforms, example)
        joints = bank.num_joints
        self.action_dim = 2 * joints if self.unified else joints
        actor, critic = self._networks(shown)
        self.normalizer = RewardNormalizer(
            num_envs, len(self.groups), gamma=config.gamma, bound=config.v_max
        )
        self.loss = FlashSACLoss(
            actor,
            critic,
            groups=self.groups,
            gamma=config.gamma,
            n_steps=config.n_step,
            alpha_init=config.alpha_init,
            target_sigma=config.target_std,
            reward_normalizer=self.normalizer,
        )
        self.stepper = FlashSACStepper(
            self.loss,
            lr=config.lr,
            lr_end=config.lr_final,
            total_updates=total_updates,
            actor_lr_scale=config.actor_lr_scale,
            actor_period=config.actor_period,
            actor_delay=config.actor_delay,
            tau=config.tau,
            generator=self.generator,
            compile=config.compile,
        )
        noise = NoiseRepetition(
            exponent=config.noise_exponent,
            maximum=config.noise_max_repeat,
            generator=self.generator,
        )
        self.policy = FlashPolicy(actor, groups=self.groups, noise=noise)
        self.nstep = NStepAssembler(config.n_step, gamma=config.gamma)
        self.codec = RowCodec(bank)
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(config.buffer_size), batch_size=config.batch_size
        )

    def _networks(self, shown: TensorDictBase) -> tuple[FlashActor, EnsembleCritic]:
        c = self.config
        width = shown[keys.OBSERVATION].shape[-1]
        future = shown.get(keys.FUTURE, None)

        def encoder(ensemble: int) -> FutureEncoder | None:
            if future is None:
                return None
            return FutureEncoder(
                future.shape[1],
                num_frames=future.shape[2],
                latent_dim=c.future_latent,
                widths=c.future_channels,
                ensemble=ensemble,
            )

        actor = FlashActor(
            width,
            self.action_dim,
            num_groups=len(self.groups),
            width=c.actor_width,
            num_blocks=c.actor_blocks,
            head="centred" if c.head == "centred" else "unit",
            init_std=c.init_std if c.head == "centred" else None,
            future_encoder=encoder(len(self.groups)),
        )
        critic = EnsembleCritic(
            width,
            self.action_dim,
            num_groups=len(self.groups),
            width=c.critic_width,
            num_blocks=c.critic_blocks,
            num_atoms=c.num_atoms,
            v_max=c.v_max,
            future_encoder=encoder(1),
        )
        return actor, critic

    @property
    def ready(self) -> bool:
        """Whether the replay buffer holds enough rows to learn from."""
        return len(self.buffer) >= self.config.min_buffer

    @torch.no_grad()
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """Actions of both hands, (N, 2, J).

        Attempt worlds act deterministically. Before the buffer is ready the other
        worlds act at random, uniformly.

        Args:
            state: compact state, batch (N,), with the ``attempt`` flag.
            explore: False makes every world deterministic.
        """
        shown = assemble(self.transforms, state)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            quiet = self._joint(self.policy(shown.copy()))
        if not explore:
            return quiet
        # A resumed learner starts with an empty buffer, but not without a policy.
        trained = self.ready or self.stepper.updates > 0
        if trained or self.config.warmup == "policy":
            with set_exploration_type(ExplorationType.RANDOM):
                noisy = self._joint(self.policy(shown.copy()))
        else:
            noisy = 2 * torch.rand(quiet.shape, generator=self.generator) - 1
        return torch.where(state[keys.ATTEMPT].unsqueeze(-1), quiet, noisy)

    def _joint(self, td: TensorDictBase) -> Tensor:
        actions = torch.cat([td[g, keys.ACTION] for g in self.groups], -1)
        actions = actions.unflatten(-1, (len(self.hands), -1))
        joint = actions.new_zeros(len(actions), 2, actions.shape[-1])
        joint[:, self.hands] = actions
        return joint

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

        Args:
            state: compact state before the step, batch (N,).
            action: (N, 2, J).
            reward: per hand, (N, 2).
            next_state: compact state after the step, before any reset.
            terminated: (N, 1) bool.
            done: (N, 1) bool.
        """
        mask = self.bank.hand_active[state[keys.MOTION].squeeze(-1)]
        if self.unified:
            self.normalizer.update(reward.sum(-1, keepdim=True), done)
        else:
            used = self.hands
            self.normalizer.update(reward[:, used], done, mask[:, used])
        row = self.nstep.push(
            state.select(*keys.STATE),
            action,
            reward,
            next_state.select(*keys.STATE),
            terminated,
            done,
        )
        if row is not None:
            self.buffer.extend(self.codec.pack(row))

    def sample(self) -> TensorDict:
        """A replay sample, assembled: what the loss reads, batch (B,)."""
        state, transition = self.codec.unpack(self.buffer.sample())
        shown = assemble(self.sample_transforms, state)
        size = transition.batch_size[0]
        wanted = [keys.OBSERVATION, keys.GROUP_MASK]
        if shown.get(keys.FUTURE, None) is not None:
            wanted.append(keys.FUTURE)
        now, after = shown.select(*wanted).split(size)
        after = after.set(keys.TERMINATED, transition[keys.TERMINATED])
        batch = now.set("next", after).set(keys.STEPS, transition[keys.STEPS])
        reward = transition[keys.REWARD]
        if self.unified:
            reward = reward.sum(-1, keepdim=True)
            actions = [transition[keys.ACTION]]
            batch.set(keys.GROUP_MASK, torch.ones_like(reward, dtype=torch.bool))
        else:
            both = transition[keys.ACTION].split(self.action_dim, -1)
            actions = [both[i] for i in self.hands]
            reward = reward[:, self.hands]
            batch.set(keys.GROUP_MASK, batch[keys.GROUP_MASK][:, self.hands])
        for i, group in enumerate(self.groups):
            batch.set((group, keys.ACTION), actions[i])
            batch.set(("next", group, keys.REWARD), reward[:, i : i + 1])
        return batch

    def update(self) -> TensorDict:
        """One FlashSAC update on a fresh sample; returns its metrics."""
        return self.stepper.update(self.sample())

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, normaliser, noise clock, n-step tail, RNG."""
        return {
            "stepper": self.stepper.state_dict(),
            "noise": self.policy.noise.state_dict(),
            "nstep": self.nstep.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.stepper.load_state_dict(state["stepper"])
        self.policy.noise.load_state_dict(state["noise"])
        self.nstep.load_state_dict(state["nstep"])
