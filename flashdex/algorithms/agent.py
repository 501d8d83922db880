"""FlashSAC's networks, loss and optimisers of a recipe, and what an update takes."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.footprint import run_backward
from flashdex.algorithms.inputs import FlatRows, HandRows, make_encoder
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.exploration import NoiseRepetition
from flashdex.modules.layers import warm_up_statistics
from flashdex.modules.policy import FlashPolicy
from flashdex.modules.product import bfloat16_products, tf32_products
from flashdex.objectives.batch import FlashBatch
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.stepper import FlashSACStepper


def make_actor(
    config: AlgoConfig,
    observation_dim: int,
    action_dim: int,
    num_groups: int,
    future_shape: tuple[int, int] | None,
) -> FlashActor:
    """The towers of all groups, with an encoder each."""
    return FlashActor(
        observation_dim,
        action_dim,
        num_groups=num_groups,
        width=config.actor_width,
        num_blocks=config.actor_blocks,
        head=config.head,
        init_std=config.init_std if config.head == "centred" else None,
        future_encoder=make_encoder(config, future_shape, num_groups),
    )


def make_critic(
    config: AlgoConfig,
    observation_dim: int,
    action_dim: int,
    num_groups: int,
    future_shape: tuple[int, int] | None,
) -> EnsembleCritic:
    """The twin critics of all groups; they share one encoder."""
    return EnsembleCritic(
        observation_dim,
        action_dim,
        num_groups=num_groups,
        width=config.critic_width,
        num_blocks=config.critic_blocks,
        num_atoms=config.num_atoms,
        v_max=config.v_max,
        critic_action=config.critic_action,
        future_encoder=make_encoder(config, future_shape, 1),
    )


def make_networks(
    config: AlgoConfig, rows: HandRows | FlatRows
) -> tuple[FlashActor, EnsembleCritic]:
    """Actor and critic of what the rows hold."""
    sizes = (rows.observation_dim, rows.action_dim, rows.num_groups, rows.future_shape)
    networks = make_actor(config, *sizes), make_critic(config, *sizes)
    if config.norm_warmup:
        for network in networks:
            warm_up_statistics(network)
    return networks


class FlashSACAgent:
    """Networks, loss, optimisers and policy; it knows sizes and groups, no environment.

    The generator, of all noise, is on the device of everything.
    """

    def __init__(
        self,
        config: AlgoConfig,
        rows: HandRows | FlatRows,
        *,
        num_envs: int,
        total_updates: int,
        generator: torch.Generator,
    ) -> None:
        self.config, self.device = config, generator.device
        self.actor, critic = make_networks(config, rows)
        self.normalizer = RewardNormalizer(
            num_envs, rows.num_groups, gamma=config.gamma, bound=config.v_max
        )
        self.loss = FlashSACLoss(
            self.actor,
            critic,
            groups=rows.names,
            gamma=config.gamma,
            n_steps=config.n_step,
            alpha_init=config.alpha_init,
            target_sigma=config.target_std,
            reward_normalizer=self.normalizer,
            own_action_gate=config.own_action_gate,
        )
        # drawn on the CPU, so that a seed means the same weights on every device
        self.loss.to(self.device)
        self.stepper = FlashSACStepper(
            self.loss,
            lr=config.lr,
            lr_end=config.lr_final,
            total_updates=total_updates,
            actor_lr_scale=config.actor_lr_scale,
            actor_period=config.actor_period,
            actor_delay=config.actor_delay,
            tau=config.tau,
            generator=generator,
            compile=config.compile,
            autocast=config.bfloat16,
        )
        noise = NoiseRepetition(
            exponent=config.noise_exponent,
            maximum=config.noise_max_repeat,
            clock=config.noise_clock,
            generator=generator,
        ).to(self.device)
        self.policy = FlashPolicy(
            self.actor,
            groups=rows.names,
            noise=noise,
            deterministic_key=rows.deterministic_key,
        )

    def update(self, batch: TensorDictBase) -> TensorDict:
        """One FlashSAC update on a sampled batch; returns its metrics."""
        with tf32_products(self.config.tf32 and self.device.type == "cuda"):
            return self.stepper.update(batch)

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, normaliser, generator and noise clock."""
        return {
            "stepper": self.stepper.state_dict(),
            "noise": self.policy.noise.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.stepper.load_state_dict(state["stepper"])
        self.policy.noise.load_state_dict(state["noise"])


def walk_update(
    loss: FlashSACLoss,
    batch: FlashBatch,
    noise: Tensor,
    *,
    lowered: bool = False,
    actor_period: int = 1,
) -> tuple[int, float]:
    """Most bytes of an update beside networks and batch, operations of its products.

    Args:
        loss: networks, on the device of the batch.
        batch: B transitions.
        noise: (G, B, A).
        lowered: large products in bfloat16.
        actor_period: the operations are those of an average update.
    """
    with bfloat16_products(lowered):
        actor, actor_flops = run_backward(
            lambda: loss.actor_objective(batch, noise)[0], loss.actor_network
        )
        critic, critic_flops = run_backward(
            lambda: loss.qvalue_objective(batch, noise)[0], loss.qvalue_network
        )
    return max(actor, critic), actor_flops / actor_period + critic_flops
