"""What a run has come to, for the terminal, whatever it trained."""

from __future__ import annotations

from pathlib import Path

from flashdex.recipe import task_of_run
from flashdex.viz.gym_table import gym_run_table
from flashdex.viz.report import write_report
from flashdex.viz.table import run_table


def run_summary(run_dir: Path) -> str:
    """Table of a run; of one with motions, the report is written as well.

    Args:
        run_dir: run directory.
    """
    if task_of_run(run_dir) == "gym":
        return gym_run_table(run_dir)
    return f"{run_table(run_dir)}\n\nreport: {write_report(run_dir)}"
