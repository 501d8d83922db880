"""The evaluations of a run on a stock environment, for a terminal."""

from __future__ import annotations

from pathlib import Path

from flashdex.viz.html import duration
from flashdex.viz.run_data import load_run

ROWS = 12  # newest evaluations shown


def gym_run_table(run_dir: str | Path) -> str:
    """Return of the deterministic policy over env steps, newest last.

    Args:
        run_dir: run directory.
    """
    run = load_run(run_dir)
    env_id = run.recipe.get("gym", {}).get("env_id", "?")
    head = (
        f"{run.recipe.get('name', run.path.name)}  {env_id}  "
        f"seed {run.recipe.get('seed', '?')}  {run.env_steps:,} env steps in "
        f"{duration(run.wall_s)}"
    )
    found = [record for record in run.metrics if "eval/return" in record]
    if not found:
        return f"{head}\nnot evaluated yet; records: {run.path / 'metrics.jsonl'}"
    lines = [f"{'env steps':>12} {'return':>9} {'std':>8} {'length':>7}"]
    lines += [
        f"{int(r['env_steps']):>12,} {r['eval/return']:>9.1f} "
        f"{r['eval/return_std']:>8.1f} {r['eval/length']:>7.0f}"
        for r in found[-ROWS:]
    ]
    return "\n".join([head, "", *lines, "", f"records: {run.path / 'metrics.jsonl'}"])
