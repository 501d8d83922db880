"""TODO docstring."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from flashdex.envs.mdp.options import default_mapping
from flashdex.system.fields import number


def _default_transforms() -> dict[str, dict[str, Any] | None]:
    return default_mapping("transforms")


def _default_rewards() -> dict[str, dict[str, Any] | None]:
    return default_mapping("rewards")


def _default_terminations() -> dict[str, dict[str, Any] | None]:
    return default_mapping("terminations")


@dataclass(frozen=True, kw_only=True)
class ResetNoise:
    """Standard deviations of the start state around the reference."""

    wrist_pos: float = number(0.001, low=0)
    """Wrist position, m."""
    wrist_rot_deg: float = number(1.0, low=0)
    """Wrist orientation, degrees."""
    finger_range: float = number(0.0125, low=0)
    """Finger joints, share of the joint range."""
    wrist_vel: float = number(0.001, low=0)
    """Added to the wrist velocity, m/s and rad/s."""
    finger_vel: float = number(0.01, low=0)
    """Replaces the finger velocity, rad/s."""


@dataclass(frozen=True, kw_only=True)
class AssistConfig:
    """PD wrench on the objects that fades while the policy learns.

    F = kp (x_ref - x) + kv (v_ref - v);
    tau = I_w [ratio kp rotvec(R_ref R^T) + sqrt(ratio) kv (w_ref - w)].
    An epoch is `epoch_steps` control steps of all worlds.
    """

    enabled: bool = False
    """Off by default; the released code has it on for 63 % of training."""
    kp: float = number(80.0, low=0)
    """Stiffness at the start, N/m."""
    kv: float = number(5.0, low=0)
    """Damping at the start, N s/m."""
    torque_ratio: float = number(96.0, low=0)
    """Angular over linear stiffness; its square root for the damping."""
    force_limit: float = number(50.0, low=0)
    """Clamp of each force component, N."""
    torque_limit: float = number(50.0, low=0)
    """Clamp of each torque component, N m."""
    epoch_steps: int = number(32, low=1)
    """Control steps an epoch."""
    window_epochs: int = number(30, low=1)
    """Epochs over which the gates are averaged; cleared at each decay."""
    wait_epochs: int = number(100, low=0)
    """Epochs before the first decay."""
    cooldown_epochs: int = number(40, low=0)
    """Epochs between two decays; shorter frees the object sooner."""
    decay: float = number(0.9, above=0, high=1)
    """Factor of the upper gain at each decay."""
    lower_ratio: float = number(0.8, low=0, high=1)
    """Lower end of the per-world draw over the upper one, after a decay."""
    zero_below: float = number(0.05, low=0)
    """All gains become zero once the upper kp is below this."""
    lower_zero_below: float = number(0.1, low=0)
    """The lower end becomes zero once it is below this."""
    task_gate: float = number(0.6, low=0, high=1)
    """Weighted object term, summed over hands, that a decay demands."""
    imitation_gate: float = number(0.01, low=0)
    """Imitation reward that a decay demands."""
    bc_gate: float = number(0.01, low=0)
    """Behaviour-cloning reward that a decay demands."""
    completion_gate: float = number(0.65, low=0, high=1)
    """Share of episodes without failure that a decay demands."""
    dial_back: bool = False
    """Return one gain level when completion falls; evaluated before the gates. The
    released code has the rule in an order that never acts."""
    dial_back_completion: float = number(0.5, low=0, high=1)
    """Completion below which a level is returned."""
    dial_back_epochs: int = number(500, low=0)
    """Epochs since the last decay before a level may be returned."""
    dial_back_factor: float = number(0.98, above=0, high=1)
    """Factor on the returned level."""


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The tracking environment."""

    compile: bool = False
    """Compile the judging of a step: a minute or more at the start, then few kernels
    instead of hundreds, which is what a GPU wants."""
    num_envs: int = number(2048, low=1)
    """Worlds simulated side by side."""
    finger_mode: Literal["absolute", "residual"] = "absolute"
    """absolute maps [-1, 1] to the joint range; residual starts on the reference,
    which learns sooner and strays less. Wrist targets are always residual."""
    wrist_pos_scale: float = number(0.1, low=0)
    """Largest wrist position residual, m."""
    wrist_rot_scale: float = number(1.0, low=0)
    """Largest wrist rotation residual, rad."""
    finger_scale: float = number(0.3, low=0)
    """Largest finger residual, rad (residual mode only)."""
    wrist_lead: bool = False
    """Wrist targets run ahead of the reference by the lag of their servos (velocity
    feed-forward), playback's too. Fast recordings need it: 50 ms at 2 m/s is 10 cm."""
    wrist_lowpass_hz: float = number(5.0, low=0)
    """Cut-off of the filter on wrist actions, 1/s; 0 = no filter."""
    reference_offset: int = number(1, low=0, high=1)
    """First reference frame shown: 1 = released code, 0 = the paper's reading."""
    max_seconds: float = number(20.0, above=0)
    """Longest episode, s; a truncation."""
    rsi: bool = True
    """Start training episodes at random frames; off, always at frame 0."""
    reset_noise: ResetNoise = dataclasses.field(default_factory=ResetNoise)
    """Noise on the start state of training worlds."""
    reset_hold_s: float = number(0.0, low=0)
    """Seconds for which objects are carried along after a reset, fading, while the
    grip forms; 0 = off, as released. Never in attempt worlds."""
    reset_hold_stiffness: float = number(40.0, above=0, high=100)
    """Natural frequency of that hold, rad/s."""
    sampler: Literal["uniform", "unconverted"] = "uniform"
    """How resets draw motions; unconverted favours those not yet converted."""
    attempt_share: float = number(0.125, low=0, high=1)
    """Share of worlds that always start at frame 0, without assist and noise, with
    the deterministic policy; their rollouts are the attempts that are scored."""
    transforms: dict[str, dict[str, Any] | None] = dataclasses.field(
        default_factory=_default_transforms
    )
    """Observation parts by name; null removes one."""
    rewards: dict[str, dict[str, Any] | None] = dataclasses.field(
        default_factory=_default_rewards
    )
    """Reward terms by name; null removes one."""
    terminations: dict[str, dict[str, Any] | None] = dataclasses.field(
        default_factory=_default_terminations
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
    num_envs: int = number(1, low=1)
    """Worlds that are collected from, stepped one after the other."""
    max_episode_steps: int | None = number(None, low=1)
    """Steps until an episode is truncated; null = the environment's own limit."""
    rescale_actions: bool = True
    """Map [-1, 1] onto the environment's action bounds; false passes actions on as
    they are, for environments that scale them themselves."""
    eval_every_env_steps: int = number(100_000, low=1)
    """Env steps between evaluations; the last one is at the end."""
    eval_episodes: int = number(50, low=1)
    """Episodes of an evaluation, by the deterministic policy, in worlds of their own
    and from the same starts every time."""
    schedule_env_steps: int | None = number(None, low=1)
    """Env steps that the learning rate is laid out for; null = total_env_steps. Set it
    to run the beginning of a longer run."""
