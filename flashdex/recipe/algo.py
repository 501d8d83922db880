"""Schema of the learning half of a recipe: algorithm, training, logging.

These dataclasses are the one place of defaults.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

from flashdex.recipe.ppo import PPOConfig
from flashdex.system.fields import number

Criterion = Literal[
    "sr_mt_obj",
    "sr_mt",
    "sr_mt_obj_x0.5",
    "sr_mt_obj_x2",
    "sr_mt_x0.5",
    "sr_mt_x2",
    "sr_loose",
    "sr_mt_obj_frame",
    "sr_mt_frame",
    "sr_mt_obj_p95",
    "sr_spider_centred",
    "sr_spider_raw",
    "sr_spider_worst",
]
CRITERIA: tuple[str, ...] = get_args(Criterion)


@dataclass(frozen=True, kw_only=True)
class AlgoConfig:
    """FlashSAC over groups of action dimensions, or the PPO baseline."""

    kind: Literal["flashsac", "ppo"] = "flashsac"
    """The algorithm; ppo is the paper's baseline and reads `algo.ppo`."""
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
    n_step: int = number(5, low=1)
    """Steps of the return before bootstrapping."""
    batch_size: int = number(4096, low=2)
    """Rows an update."""
    updates_per_step: float = number(2.0, above=0)
    """Updates a vector step (all worlds once)."""
    buffer_size: int = number(50_000_000, low=1)
    """Transitions kept; about 1 kB each."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the networks learn and the replay rows may lie; auto = a GPU where there is
    one, whichever engine steps the physics. A gym recipe learns on the CPU."""
    replay: Literal["auto", "device", "pinned", "cpu"] = "auto"
    """Where they are kept. auto and device: on the learner's device, the fastest.
    pinned: in host memory beside a CUDA device that cannot hold them, exchanged through
    page-locked buffers while both go on. cpu: in host memory, exchanged by plain copies
    that are waited for."""
    prefetch: int = number(2, low=0)
    """Batches that threads gather ahead from host memory (replay pinned or cpu); 0 =
    none, and then equal runs are equal."""
    min_buffer: int = number(100_000, low=1)
    """Transitions collected before learning."""
    warmup: Literal["uniform", "policy"] = "uniform"
    """Actions until then: uniform in [-1, 1], or the untrained policy with its noise,
    which stays near the reference and suits residual actions."""
    actor_width: int = number(128, low=8)
    """Width of each actor tower."""
    actor_blocks: int = number(2, low=1)
    """Residual blocks of each actor tower."""
    critic_width: int = number(1024, low=8)
    """Width of each critic tower; the costliest number of the learner."""
    critic_blocks: int = number(2, low=1)
    """Residual blocks of each critic tower."""
    num_atoms: int = number(101, low=3)
    """Atoms of the categorical value."""
    v_max: float = number(5.0, above=0)
    """Value support is [-v_max, v_max], after reward normalisation."""
    tau: float = number(0.01, above=0, high=1)
    """Rate of the target networks."""
    lr: float = number(3e-4, above=0)
    """Learning rate at the start."""
    lr_final: float = number(1.5e-4, low=0)
    """Learning rate at the end of the cosine."""
    actor_lr_scale: float = number(1.0, above=0)
    """Actor's learning rate over the critic's; below 1 the actor waits for the critic,
    which helps when there are few updates in all."""
    actor_period: int = number(2, low=1)
    """Critic updates an actor update."""
    actor_delay: int = number(0, low=0)
    """Critic updates before the first actor update; 0 = as published. With few updates
    in all, an untrained critic drives the actor into saturation first."""
    alpha_init: float = number(0.01, above=0)
    """Temperature at the start, each group."""
    target_std: float = number(0.15, above=0)
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
    future_latent: int = number(128, low=1)
    """Width of the encoded future window."""
    future_channels: list[int] = dataclasses.field(
        default_factory=lambda: [128, 64, 32]
    )
    """Channels of the three convolutions of the future encoder."""
    noise_max_repeat: int = number(16, low=1)
    """Longest repetition of an exploration noise, control steps; 1 = fresh."""
    noise_exponent: float = number(2.0, above=0)
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


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """The loop around the updates: checkpoints, logs, end."""

    checkpoint_every_s: float = number(300.0, above=0)
    """Seconds between checkpoints."""
    keep_checkpoints: int = number(3, low=1)
    """Newest checkpoints kept."""
    checkpoint_replay: bool = False
    """Store new replay rows beside each checkpoint, so that a resumed run learns on at
    once: the disk holds the whole buffer, about 1 kB a row."""
    log_every_s: float = number(5.0, above=0)
    """Seconds between log records."""
    wall_limit_s: float | None = number(None, above=0)
    """Stop cleanly after this many seconds, all sessions together; null = never."""
    torch_threads: int = number(0, low=0)
    """Threads of the learner on a CPU; 0 = torch's choice. With small networks more
    threads wait for each other longer than they compute."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(LoopConfig):
    """The loop around the updates: checkpoints, logs, criterion, end."""

    overlap: bool = True
    """Learn in a second thread while the physics steps: same results, faster with two
    cores."""
    stop_when_all_converted: bool = True
    """Stop once every motion is converted."""
    criterion: Criterion = "sr_mt_obj"
    """What counts as a conversion (see docs on criteria)."""
    judge: Literal["auto", "inline", "process"] = "auto"
    """Where attempts are scored and certified: in the loop, or in a process beside it;
    auto = beside it when the physics is on a GPU, which would wait for it."""
    certify: bool = True
    """Replay each conversion open loop in MuJoCo C and store the verdict."""
    render_conversions: bool = True
    """Write a small film of each conversion where a GL back end works."""


@dataclass(frozen=True, kw_only=True)
class LoggerConfig:
    """Who writes the metrics."""

    kind: list[Literal["jsonl", "csv", "wandb"]] = dataclasses.field(
        default_factory=lambda: ["jsonl"]
    )
    """Writers; the JSON lines are the truth and are always written."""
    wandb_project: str = "flashdex"
    """W&B project."""
    wandb_entity: str | None = None
    """W&B team or user; null = your default."""
    wandb_group: str | None = None
    """W&B group; null = the recipe's name."""
    wandb_mode: Literal["online", "offline"] = "online"
    """offline writes files that `wandb sync` uploads later."""
    wandb_tags: list[str] = dataclasses.field(default_factory=list)
    """Tags beside hand, motions and engine."""
