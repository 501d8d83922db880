"""Configuration of the algorithms: FlashSAC, and PPO where it differs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from flashdex.system.fields import number

Width = Annotated[int, Field(ge=1, le=2**12)]
"""Neurons or channels of a layer."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Read with `algo.kind=ppo` only.

    PPO also reads `groups`, `gamma`, `v_max` and the `future_` sizes of `algo`.
    """

    horizon: int = number(24, low=1, high=10_000)
    """Vector steps of a rollout; the training worlds times this are its rows."""
    epochs: int = number(5, low=1, high=1000)
    """Passes over a rollout."""
    minibatches: int = number(4, low=1, high=10_000)
    """Gradient steps a pass."""
    lr: float = number(1e-3, above=0, high=1)
    """Learning rate at the start, and always without a target_kl."""
    target_kl: float | None = number(0.01, above=0, high=100)
    """Divergence from the policy of the rollout that the learning rate is steered to:
    above twice as much it falls by 1.5, below half of it rises; null = constant."""
    clip: float = number(0.2, above=0, high=1)
    """Probability ratios count between 1 - clip and 1 + clip."""
    gae_lambda: float = number(0.95, low=0, high=1)
    """Decay of the advantage estimate; 1 is the whole return, 0 one step."""
    value_coef: float = number(1.0, above=0, high=1e6)
    """Weight of the squared value error."""
    value_clip: float | None = number(0.2, above=0, high=1e6)
    """Farthest a value moves from that of the rollout, normalised rewards; null = any
    distance."""
    entropy_coef: float = number(0.0, low=0, high=1e3)
    """Weight of the entropy of the policy."""
    max_grad_norm: float = number(1.0, above=0, high=1e6)
    """Gradients of a hand's actor and value together are scaled down to this norm."""
    init_std: float = number(0.2, above=0, high=10)
    """Standard deviation of the actions at the start, the same in every state."""
    hidden: Annotated[list[Width], Field(min_length=1, max_length=64)] = (
        dataclasses.field(default_factory=lambda: [512, 256, 128])
    )
    """Widths of the hidden layers of actor and value."""


@dataclass(frozen=True, kw_only=True)
class AlgoConfig:
    """FlashSAC over groups of action dimensions, or the PPO baseline."""

    kind: str = "flashsac"
    """The algorithm: flashsac, or ppo, the paper's baseline, which reads `algo.ppo`;
    others by `flashdex.algorithms.base.register`."""
    groups: Literal["per_hand", "unified"] = "per_hand"
    """One actor-critic a hand, or one for both with summed reward."""
    critic_action: Literal["joint", "own"] = "joint"
    """A hand's critics read the actions of both hands, or its own only; the other hand
    is then part of the environment."""
    own_action_gate: bool = True
    """A hand's actor follows its critics through its own action only; false lets each
    hand climb the value of the other too. No effect on own-action critics."""
    gamma: float = number(0.98, above=0, high=1)
    """Discount a control step."""
    n_step: int = number(5, low=1, high=1000)
    """Steps of the return before bootstrapping."""
    batch_size: int = number(4096, low=2, high=2**22)
    """Rows an update."""
    updates_per_step: float = number(2.0, above=0, high=1000)
    """Updates a vector step (all worlds once)."""
    buffer_size: int = number(50_000_000, low=1, high=10**10)
    """Transitions kept; about 1 kB each."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the networks learn and the replay rows may lie; auto = a GPU where there is
    one, whichever engine steps the physics. A gym recipe learns on the CPU."""
    replay: Literal["auto", "device", "pinned", "cpu"] = "auto"
    """Where they are kept. auto and device: on the learner's device, the fastest.
    pinned: in host memory beside a CUDA device that cannot hold them, exchanged through
    page-locked buffers while both go on. cpu: in host memory, exchanged by plain copies
    that are waited for."""
    prefetch: int = number(2, low=0, high=64)
    """Batches that threads gather ahead from host memory (replay pinned or cpu); 0 =
    none, and then equal runs are equal."""
    min_buffer: int = number(100_000, low=1, high=10**10)
    """Transitions collected before learning."""
    warmup: Literal["uniform", "policy"] = "uniform"
    """Actions until then: uniform in [-1, 1], or the untrained policy with its noise,
    which stays near the reference and suits residual actions."""
    actor_width: int = number(128, low=8, high=2**14)
    """Width of each actor tower."""
    actor_blocks: int = number(2, low=1, high=64)
    """Residual blocks of each actor tower."""
    critic_width: int = number(1024, low=8, high=2**14)
    """Width of each critic tower; the costliest number of the learner."""
    critic_blocks: int = number(2, low=1, high=64)
    """Residual blocks of each critic tower."""
    num_atoms: int = number(101, low=3, high=10_001)
    """Atoms of the categorical value."""
    v_max: float = number(5.0, above=0, high=1e6)
    """Value support is [-v_max, v_max], after reward normalisation."""
    tau: float = number(0.01, above=0, high=1)
    """Rate of the target networks."""
    lr: float = number(3e-4, above=0, high=1)
    """Learning rate at the start."""
    lr_final: float = number(1.5e-4, low=0, high=1)
    """Learning rate at the end of the cosine."""
    actor_lr_scale: float = number(1.0, above=0, high=1000)
    """Actor's learning rate over the critic's; below 1 the actor waits for the critic,
    which helps when there are few updates in all."""
    actor_period: int = number(2, low=1, high=10**6)
    """Critic updates an actor update."""
    actor_delay: int = number(0, low=0, high=10**9)
    """Critic updates before the first actor update; 0 = as published. With few updates
    in all, an untrained critic drives the actor into saturation first."""
    alpha_init: float = number(0.01, above=0, high=1000)
    """Temperature at the start, each group."""
    target_std: float = number(0.15, above=0, high=10)
    """Standard deviation that sets the target entropy, each action dimension."""
    init_std: float = number(0.082, low=0.007, high=0.99)
    """Standard deviation of the policy at the start (centred head, which keeps it
    between exp(-5) = 0.0067 and 1)."""
    head: Literal["centred", "unit"] = "centred"
    """centred starts at mean 0, on the reference; unit is FlashSAC's own."""
    norm_warmup: bool = False
    """BatchNorm statistics start as plain means of the updates so far; false is as
    published (mean 0, variance 1, forgotten over hundreds of updates), which a run of
    few updates never recovers from."""
    future_latent: int = number(128, low=1, high=2**14)
    """Width of the encoded future window."""
    future_channels: list[Width] = dataclasses.field(
        default_factory=lambda: [128, 64, 32]
    )
    """Channels of the three convolutions of the future encoder."""
    noise_max_repeat: int = number(16, low=1, high=10_000)
    """Longest repetition of an exploration noise, control steps; 1 = fresh."""
    noise_exponent: float = number(2.0, above=0, high=100)
    """Exponent of the repetition lengths; larger repeats less."""
    noise_clock: Literal["shared", "per_env_hand"] = "shared"
    """All worlds and hands redraw their noise together, or each by its own clock."""
    tf32: bool = True
    """Matrix products of a GPU in TF32: three decimal digits, several times the rate of
    float32. Nothing on a CPU."""
    bfloat16: bool = False
    """Large matrix products of the updates in bfloat16, everything else in float32."""
    compile: bool = False
    """Compile updates and observations: some slow minutes, then faster."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Numbers of the PPO baseline."""
