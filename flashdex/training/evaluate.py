"""``flashdex evaluate``: every motion once with the newest policy of a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from flashdex.envs.tracking import TrackingEnv
from flashdex.metrics.aggregate import mean_object_errors, mope_more
from flashdex.system.files import write_atomic
from flashdex.training.assemble import restore
from flashdex.training.build import open_workbench
from flashdex.training.checkpoint import EVALUATED, load_checkpoint
from flashdex.training.evaluator import roll_all
from flashdex.training.run_dir import load_run_recipe
from flashdex.training.session import stored_value

SHOWN = ("sr_mt_obj", "sr_mt", "sr_spider_raw", "sr_spider_centred")


@dataclass(frozen=True)
class Evaluation:
    """Scores of one evaluation.

    Attributes:
        rows: one dict a motion: name, verdict state of each criterion, errors.
        totals: rates and mean errors of the collection.
    """

    rows: list[dict[str, Any]]
    totals: dict[str, Any]


def evaluate(run: str | Path, overrides: list[str] | None = None) -> Evaluation:
    """Roll every motion from frame 0, deterministic, no assist, no terminations.

    Args:
        run: run directory with a checkpoint.
        overrides: changes to the stored recipe, for instance other physics.

    Returns:
        Per-motion scores, also written to ``evaluation.json`` in the run.
    """
    run_dir = Path(run)
    recipe = load_run_recipe(run_dir, overrides)
    state = load_checkpoint(run_dir, EVALUATED)
    bench = open_workbench(recipe)
    # The learner keeps a running return a world: as many as it was trained with.
    num_envs = stored_value(state["recipe"], "env.num_envs")
    learner = bench.make_learner(bench.make_env(num_envs=num_envs))
    restore(learner, state)

    def act(td: TensorDictBase, env: TrackingEnv) -> Tensor:
        return learner.act(td.to(learner.device), explore=False)

    criterion = recipe.train.criterion
    rows, errors = [], []
    for rollout in roll_all(bench, act, env_steps=state["env_steps"]):
        verdicts = rollout.score()
        wanted = dict.fromkeys([criterion, *SHOWN])
        rows.append(
            {
                "motion": rollout.motion,
                **{name: verdicts[name].state for name in wanted},
                "errors": {
                    k: round(v, 5) for k, v in verdicts[criterion].values.items()
                },
            }
        )
        mean = mean_object_errors(rollout.tracking_errors())
        errors.append((mean, verdicts["sr_spider_centred"]))
    totals: dict[str, Any] = {"env_steps": state["env_steps"], **mope_more(errors)}
    for name in dict.fromkeys([criterion, *SHOWN]):
        states = [row[name] for row in rows]
        totals[name] = {
            s: states.count(s) for s in ("passed", "failed", "not_measured")
        }
    text = json.dumps({"totals": totals, "motions": rows}, indent=1)
    write_atomic(run_dir / "evaluation.json", text)
    return Evaluation(rows, totals)
