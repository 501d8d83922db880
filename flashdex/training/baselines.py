"""What no learning achieves: the scores every policy is read against."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex.envs.tracking import TrackingEnv
from flashdex.metrics.criteria import criterion_names, score
from flashdex.metrics.criteria_table import Verdict
from flashdex.metrics.errors import frozen_object
from flashdex.rollouts.build import grace_steps
from flashdex.system.files import write_atomic
from flashdex.training.build import RunBuilder
from flashdex.training.evaluator import roll_all


@dataclass(frozen=True)
class Baselines:
    """Scores of each baseline on each motion.

    Attributes:
        rows: baseline -> motion -> {"passed": criteria, "errors": ..., "why": ...}.
    """

    rows: dict[str, dict[str, dict[str, Any]]]

    def trivial(self, criterion: str) -> dict[str, list[str]]:
        """Baselines that already pass ``criterion``, by motion."""
        out: dict[str, list[str]] = {}
        for name, motions in self.rows.items():
            for motion, row in motions.items():
                if criterion in row["passed"]:
                    out.setdefault(motion, []).append(name)
        return out


def hold_first_pose(env: TrackingEnv) -> Tensor:
    """``do_nothing``: the hand holds its first reference joint position."""
    first = torch.zeros_like(env.motion)
    return env.bank.at(env.motion, first, ("joint_pos",))["joint_pos"]


def follow_reference(env: TrackingEnv) -> Tensor:
    """``kinematic_playback``: the retargeted joints as position targets."""
    ref = env.bank.at(env.motion, env.frame, ("joint_pos", "joint_vel"))
    return env.leading_reference(ref)


BASELINES = {"do_nothing": hold_first_pose, "kinematic_playback": follow_reference}


def score_baselines(builder: RunBuilder, path: Path | None = None) -> Baselines:
    """Roll and score all baselines on all motions; reuse the file of this run."""
    if path is not None and path.is_file():
        return Baselines(json.loads(path.read_text(encoding="utf-8")))
    joints = builder.bank.num_joints

    def idle(td: TensorDictBase, env: TrackingEnv) -> Tensor:
        return torch.zeros(env.num_envs, 2, joints, device=env.device)

    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for name, target in BASELINES.items():
        rollouts = roll_all(builder, idle, target=target)
        rows[name] = {r.motion: _row(builder, r.score()) for r in rollouts}
    rows["frozen_object"] = _score_frozen(builder)
    if path is not None:
        write_atomic(path, json.dumps(rows, indent=1))
    return Baselines(rows)


def _score_frozen(builder: RunBuilder) -> dict[str, dict[str, Any]]:
    """``frozen_object``: objects stay at their first reference pose."""
    bank = builder.bank_on(torch.device("cpu"))
    out: dict[str, dict[str, Any]] = {}
    for row, name in enumerate(bank.names):
        frames = torch.arange(int(bank.length[row]))
        ref = bank.at(torch.full_like(frames, row), frames)
        slots = torch.where(bank.has_object[row], bank.hand_slot[row], -1)
        errors = frozen_object(
            ref["object_pos"].double(),
            ref["object_quat"].double(),
            hand_active=bank.hand_active[row].tolist(),
            hand_object=slots.tolist(),
            fps=bank.fps,
        )
        out[name] = _row(builder, score(errors, grace=grace_steps(bank.fps)))
    return out


def _row(builder: RunBuilder, verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    """Scores of one motion."""
    verdict = verdicts[builder.recipe.train.criterion]
    return {
        "passed": [k for k, v in verdicts.items() if v.is_passed],
        "state": verdict.state,
        "errors": {k: round(v, 5) for k, v in verdict.values.items()},
    }


def format_baselines(baselines: Baselines) -> str:
    """A table: how many motions each baseline passes, by criterion."""
    names = list(baselines.rows)
    total = len(next(iter(baselines.rows.values())))
    lines = [
        f"of {total} motions, how many pass without learning. do_nothing holds the",
        "first pose, kinematic_playback follows the reference; with frozen_object the",
        "object never moves",
        f"{'criterion':<24}" + "".join(f"{n:>20}" for n in names),
    ]
    for criterion in criterion_names():
        if criterion.endswith(("_left", "_right")):
            continue
        counts = [
            sum(criterion in row["passed"] for row in baselines.rows[n].values())
            for n in names
        ]
        lines.append(f"{criterion:<24}" + "".join(f"{c:>20}" for c in counts))
    return "\n".join(lines)
