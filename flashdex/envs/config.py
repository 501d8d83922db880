"""Configuration of the environments: the tracking env and stock Gymnasium ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from flashdex.envs.feedforward import Feedforward
from flashdex.envs.mdp.assist import AssistConfig
from flashdex.envs.mdp.resets import ResetNoise
from flashdex.envs.mdp.term import default_mapping
from flashdex.system.fields import number

Terms = dict[str, dict[str, Any] | None]
"""Terms by name, with the options that differ from their defaults; null is off."""


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The tracking environment."""

    compile: bool = False
    """Compile the judging of a step: a minute or more at the start, then few kernels
    instead of hundreds, which is what a GPU wants."""
    num_envs: int = number(2048, low=1, high=2**20)
    """Worlds simulated side by side."""
    finger_mode: Literal["absolute", "residual"] = "absolute"
    """absolute maps [-1, 1] to the joint range; residual starts on the reference,
    which learns sooner and strays less. Wrist targets are always residual."""
    wrist_pos_scale: float = number(0.1, low=0, high=10)
    """Largest wrist position residual, m."""
    wrist_rot_scale: float = number(1.0, low=0, high=10)
    """Largest wrist rotation residual, rad."""
    finger_scale: float = number(0.3, low=0, high=10)
    """Largest finger residual, rad (residual mode only)."""
    feedforward: Feedforward = "none"
    """Where wrist targets stand before any action, playback's too: none on the
    reference, lag ahead by what the servos trail a steady motion (50 ms at 2 m/s is
    10 cm), inverse by all of their inverse dynamics."""
    wrist_lowpass_hz: float = number(5.0, low=0, high=10_000)
    """Cut-off of the filter on wrist actions, 1/s; 0 = no filter."""
    reference_offset: int = number(1, low=0, high=1)
    """First reference frame shown: 1 = released code, 0 = the paper's reading."""
    max_seconds: float = number(20.0, above=0, high=3600)
    """Longest episode, s; a truncation."""
    rsi: bool = True
    """Start training episodes at random frames; off, always at frame 0."""
    reset_noise: ResetNoise = dataclasses.field(default_factory=ResetNoise)
    """Noise on the start state of training worlds."""
    reset_hold_s: float = number(0.0, low=0, high=3600)
    """Seconds for which objects are carried along after a reset, fading, while the
    grip forms; 0 = off, as released. Never in attempt worlds."""
    reset_hold_stiffness: float = number(40.0, above=0, high=100)
    """Natural frequency of that hold, rad/s."""
    sampler: Literal["uniform", "unconverted"] = "uniform"
    """How resets draw motions; unconverted favours those not yet converted."""
    attempt_share: float = number(0.125, low=0, high=1)
    """Share of worlds that always start at frame 0, without assist and noise, with
    the deterministic policy; their rollouts are the attempts that are scored."""
    transforms: Terms = dataclasses.field(
        default_factory=partial(default_mapping, "transforms")
    )
    """Observation parts by name; null removes one."""
    rewards: Terms = dataclasses.field(
        default_factory=partial(default_mapping, "rewards")
    )
    """Reward terms by name; null removes one."""
    terminations: Terms = dataclasses.field(
        default_factory=partial(default_mapping, "terminations")
    )
    """Failure terminations by name; null removes one."""
    assist: AssistConfig | None = dataclasses.field(default_factory=AssistConfig)
    """The fading wrench on objects; null is the same as enabled: false."""


@dataclass(frozen=True, kw_only=True)
class GymConfig:
    """The environment, and how the policy is evaluated in it."""

    env_id: str = ""
    """Registered id, `HalfCheetah-v4` for example: flat observations, continuous
    actions; must be given."""
    num_envs: int = number(1, low=1, high=2**20)
    """Worlds that are collected from, stepped one after the other."""
    max_episode_steps: int | None = number(None, low=1, high=10**9)
    """Steps until an episode is truncated; null = the environment's own limit."""
    rescale_actions: bool = True
    """Map [-1, 1] onto the environment's action bounds; false passes actions on as
    they are, for environments that scale them themselves."""
    eval_every_env_steps: int = number(100_000, low=1, high=10**12)
    """Env steps between evaluations; the last one is at the end."""
    eval_episodes: int = number(50, low=1, high=10**6)
    """Episodes of an evaluation, by the deterministic policy, in worlds of their own
    and from the same starts every time."""
    schedule_env_steps: int | None = number(None, low=1, high=10**12)
    """Env steps that the learning rate is laid out for; null = total_env_steps. Set it
    to run the beginning of a longer run."""
