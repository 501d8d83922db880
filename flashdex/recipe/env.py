"""Schema of the environment half of a recipe: motions, physics, env, assist.

These dataclasses are the one place of defaults. Metres, radians, seconds, kilograms.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from flashdex.recipe.options import default_mapping
from flashdex.system.fields import number


def _default_transforms() -> dict[str, dict[str, Any] | None]:
    return default_mapping("transforms")


def _default_rewards() -> dict[str, dict[str, Any] | None]:
    return default_mapping("rewards")


def _default_terminations() -> dict[str, dict[str, Any] | None]:
    return default_mapping("terminations")


SourceName = Literal[
    "procedural",
    "keypoints",
    "myodm",
    "taco",
    "oakink2",
    "hot3d",
    "arctic",
    "grab",
    "spider",
    "fdr",
]
"""Readers of recordings; `flashdex.datasets.SOURCES` has the same names."""


@dataclass(frozen=True, kw_only=True)
class MotionsConfig:
    """Which motions are trained on: a prepared library, or a source to prepare."""

    library: str | None = None
    """Folder of a prepared library; when given, nothing is prepared."""
    source: SourceName | None = None
    """Reader of the recordings, which are prepared when no library is given."""
    input: str | None = None
    """Folder or file the reader reads; procedural and myodm need none."""
    mano: str | None = None
    """Folder with MANO_LEFT and MANO_RIGHT, for sources that need the hand model."""
    models: str | None = None
    """Folder of the object models, where it lies apart from the recordings."""
    speed: float = number(1.0, above=0)
    """Playback speed of the recordings; 0.5 makes a motion last twice as long."""
    select: list[str] | None = None
    """Names or globs of the motions to keep; null keeps all."""
    count: int | None = number(None, low=1)
    """How many motions to keep or, for procedural ones, to make; null = all."""
    seed: int = number(0, low=0)
    """Seed of procedural motions and of preparation."""
    control_hz: float = number(60.0, above=0)
    """Control rate at which a source is prepared, 1/s; a library keeps its own, which
    must be one over physics.timestep x physics.decimation."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The physics engine and its numbers."""

    engine: Literal["cpu", "warp", "brax"] = "cpu"
    """cpu = MuJoCo C on all cores; warp = all worlds on one NVIDIA GPU; brax = MJX on
    JAX, for collections whose motions all use the same objects."""
    decimation: int = number(4, low=1)
    """Physics substeps a control step; fewer is faster and less stable."""
    timestep: float = number(1 / 240, above=0)
    """Physics step, s; timestep x decimation must be one control step."""
    gains: Literal["vendor", "paper"] = "vendor"
    """Servo gains; vendor = what the real motors can follow (1.1 and 0.4 N m on
    XHand), paper = 20/1.5 with 100 N m, slower and far stronger."""
    gravcomp: float = number(1.0, low=0, high=1)
    """Share of the hand's weight that is compensated; 0 is the released code."""
    friction: float = number(1.0, low=0)
    """Sliding friction of hand geoms."""
    object_friction: float = number(2.0, low=0)
    """Sliding friction of object geoms; the larger of a pair counts."""
    support_friction: float = number(1.0, low=0)
    """Sliding friction of supports; the larger of a pair counts."""
    condim: int = number(4, low=3, high=6)
    """Contact dimensions of objects: 3 = sliding, 4 adds torsion at the fingertip."""
    impratio: float = number(10.0, above=0)
    """Friction over normal constraint stiffness; larger slips less."""
    support_disks: bool = True
    """Rebuild tables and shelves as discs; off, objects have no support at all."""
    hand_support_contact: bool = True
    """Hands touch supports; off, they pass through tables as in a mocap overlay."""
    iterations: int = number(20, low=1)
    """Solver iterations; certificates use more."""
    ls_iterations: int = number(50, low=1)
    """Line-search iterations."""
    num_threads: int = number(0, low=0)
    """Threads of the cpu engine; 0 = all cores."""
    nconmax: int | None = number(None, low=1, high=10_000)
    """Contacts a world, warp only; null = four for each geom that moves. All worlds
    share the room."""
    njmax: int | None = number(None, low=1, high=20_000)
    """Constraint rows a world, warp only; null = those of so many contacts and of all
    joint limits."""


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
