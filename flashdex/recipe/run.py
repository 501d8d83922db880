"""Schema of the learning half of a recipe: algorithm, training, logging.

These dataclasses are the one place of defaults.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from flashdex.metrics.criteria_table import CriterionName
from flashdex.system.fields import number


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """The loop around the updates: checkpoints, logs, end."""

    checkpoint_every_s: float = number(300.0, above=0, high=1e9)
    """Seconds between checkpoints."""
    keep_checkpoints: int = number(3, low=1, high=10**6)
    """Newest checkpoints kept."""
    checkpoint_replay: bool = False
    """Store new replay rows beside each checkpoint, so that a resumed run learns on at
    once: the disk holds the whole buffer, about 1 kB a row."""
    log_every_s: float = number(5.0, above=0, high=1e9)
    """Seconds between log records."""
    wall_limit_s: float | None = number(None, above=0, high=1e9)
    """Stop cleanly after this many seconds, all sessions together; null = never."""
    torch_threads: int = number(0, low=0, high=256)
    """Threads of the learner on a CPU; 0 = torch's choice. With small networks more
    threads wait for each other longer than they compute."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(LoopConfig):
    """The loop around the updates: checkpoints, logs, criterion, end."""

    overlap: bool = True
    """Learn in a second thread while the physics steps: same results, faster with two
    cores."""
    stop_when_all_converted: bool = True
    """Stop once every motion has a conversion in which its object moves as it must."""
    criterion: CriterionName = "sr_mt_obj"
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
