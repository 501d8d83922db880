"""FlashSAC of a recipe on any observation: networks, loss, optimisers and policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from flashdex.algorithms.config import AlgoConfig
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.exploration import NoiseRepetition
from flashdex.modules.future import FutureEncoder
from flashdex.modules.layers import warm_up_statistics
from flashdex.modules.policy import FlashPolicy
from flashdex.modules.product import tf32_products
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.stepper import FlashSACStepper


class FlashSACAgent:
    """What learns in a FlashSAC run; it knows sizes and group names, no environment.

    Args:
        config: algorithm part of the recipe.
        observation_dim: width of the observation.
        future_shape: channels and frames of the future window, or None.
        action_dim: actions of one group.
        groups: group names; None is a single-agent environment.
        num_envs: worlds that are collected from.
        total_updates: horizon of the learning-rate schedule.
        generator: source of the exploration and policy noise; its device is that of
            everything else.
        deterministic_key: key of the worlds that never explore, see `FlashPolicy`.
    """

    def __init__(
        self,
        config: AlgoConfig,
        *,
        observation_dim: int,
        future_shape: tuple[int, int] | None = None,
        action_dim: int,
        groups: Sequence[str] | None = None,
        num_envs: int,
        total_updates: int,
        generator: torch.Generator,
        deterministic_key: NestedKey | None = None,
    ) -> None:
        self.config, self.device = config, generator.device
        number = 1 if groups is None else len(groups)
        self.actor = make_actor(
            config, observation_dim, action_dim, number, future_shape
        )
        critic = make_critic(config, observation_dim, action_dim, number, future_shape)
        if config.norm_warmup:
            warm_up_statistics(self.actor)
            warm_up_statistics(critic)
        self.normalizer = RewardNormalizer(
            num_envs, number, gamma=config.gamma, bound=config.v_max
        )
        self.loss = FlashSACLoss(
            self.actor,
            critic,
            groups=groups,
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
            self.actor, groups=groups, noise=noise, deterministic_key=deterministic_key
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


def make_encoder(
    config: AlgoConfig, shape: tuple[int, int] | None, ensemble: int
) -> FutureEncoder | None:
    """Encoder of a future window of ``shape`` (channels, frames), or None."""
    if shape is None:
        return None
    return FutureEncoder(
        shape[0],
        num_frames=shape[1],
        latent_dim=config.future_latent,
        widths=config.future_channels,
        ensemble=ensemble,
    )
