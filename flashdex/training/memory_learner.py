"""Bytes of a learner: networks, optimisers, one update, rows and observations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from tensordict import TensorDict
from torch import nn

from flashdex import keys
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.flashsac import make_actor, make_critic
from flashdex.algorithms.inputs import HandGroups, make_encoder
from flashdex.envs.config import EnvConfig
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.tracking import state_spec
from flashdex.envs.transforms.build import make_transforms
from flashdex.envs.transforms.compiled import Assembly
from flashdex.hands.spec import HandSpec
from flashdex.modules.gaussian_policy import GaussianPolicy, ValueNet
from flashdex.modules.layers import warm_up_statistics
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.replay.codec import RowCodec, row_bytes
from flashdex.training.memory_walk import (
    PeakMeter,
    flashsac_flops,
    gradient_bytes,
    make_flash_batch,
    tensor_bytes,
    walk_flashsac,
)

_FEW, _MORE = 32, 64  # rows assembled to see what one more takes
_ADAM_STEP = 4  # bytes of Adam's own counter, one a parameter tensor


@dataclass(frozen=True)
class NetworkBytes:
    """What networks and their optimisers keep.

    Attributes:
        weights: parameters and buffers, target network included.
        gradients: of what is trained.
        moments: both moments of Adam and its counters.
    """

    weights: int
    gradients: int
    moments: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.weights + self.gradients + self.moments


def network_bytes(network: nn.Module) -> NetworkBytes:
    """What a module keeps while Adam trains it.

    Args:
        network: on any device; parameters without gradient are not trained.
    """
    # LossModule lists the trained parameters only
    everything = [p for _, p in nn.Module.named_parameters(network)]
    trained = [p for p in everything if p.requires_grad]
    gradients = tensor_bytes(trained)
    return NetworkBytes(
        weights=tensor_bytes(everything) + tensor_bytes(list(network.buffers())),
        gradients=gradients,
        moments=2 * gradients + _ADAM_STEP * len(trained),
    )


class LearnerSizes:
    """Sizes of a recipe's learner, read off the parts themselves.

    Args:
        algo: algorithm part of the recipe; its batch and buffer play no role here.
        env: environment part of the recipe.
        bank: reference frames, of a stand-in or real.
        hands: hand specs by side.
    """

    def __init__(
        self,
        algo: AlgoConfig,
        env: EnvConfig,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
    ) -> None:
        self.algo, self.bank = algo, bank
        self.links = hands["left"].num_links
        self.groups = HandGroups.of(bank, unified=algo.groups == "unified")
        transforms = make_transforms(
            env.transforms, bank, hands, reference_offset=env.reference_offset
        )
        self.assembly, self.codec = Assembly(transforms), RowCodec(bank)
        shown = self.assembly(self.state(1))
        self.observation = shown[keys.OBSERVATION].shape[-1]
        window = shown.get(keys.FUTURE, None)
        self.future: tuple[int, int] | None = None
        if window is not None:
            self.future = (window.shape[1], window.shape[2])
        self.update_bytes = lru_cache(self._update_bytes)

    def state(self, count: int) -> TensorDict:
        """Compact states of zeros, (count,)."""
        bank = self.bank
        spec = state_spec(count, bank.num_joints, bank.num_slots, self.links)
        return TensorDict(dict(spec.zero().items()), batch_size=[count])

    def row(self, count: int) -> TensorDict:
        """n-step rows of zeros before packing, (count,)."""
        state = self.state(count).select(*keys.STATE)
        row = {
            "state": state,
            "next_state": state.clone(),
            "action": torch.zeros(count, 2, self.bank.num_joints),
            "reward": torch.zeros(count, 2),
            "terminated": torch.zeros(count, 1, dtype=torch.bool),
            "steps": torch.ones(count, 1, dtype=torch.int64),
        }
        return TensorDict(row, batch_size=[count])

    @cached_property
    def row_bytes(self) -> int:
        """A packed replay row."""
        return row_bytes(self.codec.pack(self.row(1)))

    @cached_property
    def step_bytes(self) -> int:
        """One step of one world before packing: states, action, reward, flags."""
        return tensor_bytes(list(self.row(1).values(True, True)))

    @cached_property
    def assembled_bytes(self) -> int:
        """One observation while it is made from a packed state: slope of the peak."""
        few, more = self._assembly_peak(_FEW), self._assembly_peak(_MORE)
        return -(-(more - few) // (2 * (_MORE - _FEW)))  # a row has two ends

    @torch.no_grad()
    def _assembly_peak(self, count: int) -> int:
        packed = self.codec.pack(self.row(count))
        with PeakMeter() as meter:
            state, transition = self.codec.unpack(packed.clone())
            shown = self.assembly(state)
        del transition, shown
        return meter.peak

    @cached_property
    def loss(self) -> FlashSACLoss:
        """The recipe's networks without memory."""
        algo, count = self.algo, len(self.groups.names)
        sizes = (self.observation, self.groups.action_dim, count, self.future)
        with torch.device("meta"):
            actor, critic = make_actor(algo, *sizes), make_critic(algo, *sizes)
            if algo.norm_warmup:
                warm_up_statistics(actor)
                warm_up_statistics(critic)
            return FlashSACLoss(actor, critic, groups=self.groups.names)

    @cached_property
    def ppo(self) -> list[tuple[GaussianPolicy, ValueNet]]:
        """The PPO baseline's networks without memory, of every group."""
        algo, hidden = self.algo, self.algo.ppo.hidden
        found = []
        with torch.device("meta"):
            for _ in self.groups.names:
                policy = GaussianPolicy(
                    self.observation,
                    self.groups.action_dim,
                    hidden=hidden,
                    init_std=algo.ppo.init_std,
                    encoder=make_encoder(algo, self.future, 1),
                )
                encoder = make_encoder(algo, self.future, 1)
                value = ValueNet(self.observation, hidden=hidden, encoder=encoder)
                found.append((policy, value))
        return found

    @cached_property
    def networks(self) -> NetworkBytes:
        """Networks and optimisers."""
        if self.algo.kind == "ppo":
            return network_bytes(nn.ModuleList([n for pair in self.ppo for n in pair]))
        return network_bytes(self.loss)

    def _update_bytes(self, size: int) -> int:
        """An update on ``size`` rows besides `networks`: batch and activations."""
        if self.algo.kind == "ppo":
            return self._ppo_update_bytes(size)
        batch, noise = make_flash_batch(
            self.loss, size=size, observation=self.observation, future=self.future
        )
        peak = walk_flashsac(self.loss, batch, noise, lowered=self.algo.bfloat16)
        return peak + tensor_bytes([batch, noise])

    def update_flops(self, size: int) -> float:
        """Matrix products of one FlashSAC update on ``size`` rows, operations."""
        batch, noise = make_flash_batch(
            self.loss, size=size, observation=self.observation, future=self.future
        )
        period = self.algo.actor_period
        return flashsac_flops(self.loss, batch, noise, actor_period=period)

    def _ppo_update_bytes(self, size: int) -> int:
        policy, value = self.ppo[0]
        with torch.device("meta"):
            seen = torch.randn(size, self.observation)
            window = None if self.future is None else torch.randn(size, *self.future)
        with PeakMeter() as meter:
            mean, std = policy(seen, window)
            ((mean / std).sum() + value(seen, window).sum()).backward()
        gradients = gradient_bytes(policy) + gradient_bytes(value)
        for network in (policy, value):
            network.zero_grad(set_to_none=True)
        return meter.peak - gradients + tensor_bytes([seen, window])
