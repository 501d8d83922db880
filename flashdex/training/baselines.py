"""What no learning achieves: the scores every policy is read against."""

from __future__ import annotations

import dataclasses
import logging
import random
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex.envs.scene.scene import SceneLayout
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import RunError
from flashdex.metrics.criteria import criterion_names, score
from flashdex.metrics.criteria_table import Verdict
from flashdex.metrics.errors import frozen_object
from flashdex.motions.library_format import hash_json
from flashdex.recipe import Recipe
from flashdex.rollouts.build import grace_steps
from flashdex.rollouts.findings import Finding, at, differences
from flashdex.system.jsonl import read_object, write_object
from flashdex.system.machine import versions
from flashdex.system.run_files import BASELINES as FILE
from flashdex.system.run_files import VERSIONS
from flashdex.training.build import RunBuilder
from flashdex.training.evaluator import roll_all


@dataclass(frozen=True)
class Baselines:
    """Scores of each baseline on each motion.

    Attributes:
        rows: baseline -> motion -> {"passed": criteria, "state": ..., "errors": ...}.
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
    return env.bank.at(env.motion, env.frame, ("joint_target",))["joint_target"]


BASELINES = {"do_nothing": hold_first_pose, "kinematic_playback": follow_reference}
FROZEN = "frozen_object"
# of a row: the hash of its scores and of what they depend on
SEAL = "sha256"
# of the environment: what a baseline's one episode from frame 0 never meets
NO_MATTER = {"compile", "num_envs", "rsi", "sampler", "attempt_share", "assist"}
NO_MATTER |= {"reset_noise", "reset_hold_s", "reset_hold_stiffness"}
NO_MATTER |= {"transforms", "rewards", "terminations", "reference_offset"}
RECOMPUTED = 8  # motions whose baselines a verification scores again
_LOG = logging.getLogger(__name__)


def score_baselines(
    builder: RunBuilder, path: Path | None = None, *, only: Collection[str] = ()
) -> Baselines:
    """Roll and score all baselines on all motions, or ``only`` on those named.

    What the file of this run knows is reused, motion by motion: of the same content, by
    the same physics. A row that was edited is scored again.
    """
    known = {} if path is None else _read_known(path)
    inputs = _inputs(builder)
    rows_of = {name: row for row, name in enumerate(inputs)}
    inputs = {name: inputs[name] for name in only or inputs}
    joints = builder.bank.num_joints

    def idle(td: TensorDictBase, env: TrackingEnv) -> Tensor:
        return torch.zeros(env.num_envs, 2, joints, device=env.device)

    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for name in (*BASELINES, FROZEN):
        old = known.get(name, {})
        mine = {
            motion: old[motion]
            for motion, made_of in inputs.items()
            if _is_sealed(old.get(motion), made_of)
        }
        todo = [rows_of[motion] for motion in inputs if motion not in mine]
        if name == FROZEN:
            mine |= _score_frozen(builder, todo)
        else:
            for rollout in roll_all(builder, idle, target=BASELINES[name], rows=todo):
                mine[rollout.motion] = _row(builder, rollout.score())
        rows[name] = {m: _sealed(mine[m], made_of) for m, made_of in inputs.items()}
    if path is not None and rows != known:
        write_object(rows, path.parent, path.name)
    return Baselines(rows)


def check_baselines(
    builder: RunBuilder, run_dir: Path, former: Sequence[Recipe]
) -> list[Finding]:
    """Where the scores of a run are not those that are computed now.

    Of at most ``RECOMPUTED`` motions, chosen by the content of the library, where the
    same engine, MuJoCo and processor are at hand. A resume that was killed leaves those
    of one of the ``former`` recipes.
    """
    engine = builder.recipe.physics.engine
    said, here = read_object(run_dir, VERSIONS), versions(engine)
    if engine != "cpu" or any(said.get(k) != here[k] for k in ("mujoco", "hardware")):
        text = "are of another engine, MuJoCo or computer, and not computed again"
        return [Finding(FILE, "scores", text, is_fault=False)]
    stored, names = read_object(run_dir, FILE), builder.bank.names
    chosen = random.Random(builder.library.content_hash).sample(
        sorted(names), min(RECOMPUTED, len(names))
    )
    found, before = [], [_inputs(replace(builder, recipe=r)) for r in former]
    for name, motions in score_baselines(builder, only=chosen).rows.items():
        for motion, row in motions.items():
            said = at(stored, name, motion)
            texts = differences(said, row, at=f"{name}.{motion}")
            if texts and any(_is_sealed(said, inputs[motion]) for inputs in before):
                text = "of motions by an earlier recipe"
                found.append(Finding(FILE, "scores", text, is_fault=False))
                continue
            found += [Finding(FILE, name, text) for text in texts]
    if len(names) > len(chosen):
        text = f"of {len(names) - len(chosen)} of {len(names)} motions"
        found.append(Finding(FILE, "scores", text, is_fault=False))
    return found


def _read_known(path: Path) -> dict[str, Any]:
    """Scores of an earlier session; nothing where they cannot be read."""
    try:
        known = read_object(path.parent, path.name)
    except RunError as error:
        _LOG.warning("%s Baselines are scored again", error)
        return {}
    return {name: table for name, table in known.items() if isinstance(table, dict)}


def _inputs(builder: RunBuilder) -> dict[str, str]:
    """Hash of all that the scores of a motion depend on, by motion."""
    recipe, library = builder.recipe, builder.library
    physics, env = dataclasses.asdict(recipe.physics), dataclasses.asdict(recipe.env)
    shared = {
        "hand": recipe.hand,
        "physics": {k: v for k, v in physics.items() if k != "num_threads"},
        "env": {k: v for k, v in env.items() if k not in NO_MATTER},
        "criterion": recipe.train.criterion,
        "layout": dataclasses.asdict(SceneLayout.of(library)),
        "mujoco": version("mujoco"),
    }
    return {
        name: hash_json([shared, library.motion_hash(row)])
        for row, name in enumerate(builder.bank.names)
    }


def _sealed(row: dict[str, Any], made_of: str) -> dict[str, Any]:
    scores = {key: value for key, value in row.items() if key != SEAL}
    return {**scores, SEAL: hash_json([made_of, scores])}


def _is_sealed(row: Any, made_of: str) -> bool:
    return isinstance(row, dict) and row == _sealed(row, made_of)


def _score_frozen(builder: RunBuilder, rows: list[int]) -> dict[str, dict[str, Any]]:
    """``frozen_object``: objects stay at their first reference pose."""
    bank = builder.bank_on(torch.device("cpu"))
    out: dict[str, dict[str, Any]] = {}
    for row in rows:
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
        verdicts = score(errors, grace=grace_steps(bank.fps))
        out[bank.names[row]] = _row(builder, verdicts)
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
