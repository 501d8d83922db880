"""Choose the motions of a benchmark by a rule, from a library and its baselines.

    flashdex baselines real_cpu motions.library=libraries/myodm --out scores.json
    python -m benchmarks.choose_motions libraries/myodm scores.json --count 50

The rule: a motion is eligible when neither an object that never moves (frozen_object)
nor a hand that holds still (do_nothing) passes it by any criterion, and the reference
played back does not by the usual one (sr_mt_obj). Of the eligible
ones those are taken whose recording is cleanest, that is, whose human fingertips are
least deep inside the object; equal depths in name order. Prints a YAML list.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

TRIVIAL = ("do_nothing", "frozen_object")
PLAYBACK, USUAL = "kinematic_playback", "sr_mt_obj"
DEPTH = "human_tip_depth_mm"


def choose(
    report: list[dict[str, str]], scores: dict[str, dict[str, dict]], count: int
) -> tuple[list[str], int]:
    """Names of the chosen motions in name order, and how many were eligible.

    Scores lead from baseline to motion to {"passed": criteria}.
    """
    eligible = [
        row
        for row in report
        if row["status"] != "rejected"
        and not any(scores[name][row["motion"]]["passed"] for name in TRIVIAL)
        and USUAL not in scores[PLAYBACK][row["motion"]]["passed"]
    ]
    eligible.sort(key=lambda row: (float(row[DEPTH]), row["motion"]))
    return sorted(row["motion"] for row in eligible[:count]), len(eligible)


def main() -> None:
    """Read the two files, print the list."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", type=Path)
    parser.add_argument("baselines", type=Path)
    parser.add_argument("--count", type=int, default=50)
    args = parser.parse_args()
    with (args.library / "report.csv").open(encoding="utf-8", newline="") as file:
        report = list(csv.DictReader(file))
    scores = json.loads(args.baselines.read_text(encoding="utf-8"))
    names, eligible = choose(report, scores, args.count)
    print(f"# {len(names)} of {eligible} eligible, {len(report)} recordings")
    print("\n".join(f"- {name}" for name in names))


if __name__ == "__main__":
    main()
