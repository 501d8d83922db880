"""Print what a training run achieved, as the JSON kept in benchmarks/results.

Usage: python -m benchmarks.summarise_run RUN --command "make quickstart" --note "..."
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from flashdex.reports.run.facts import count, load_run, motion_facts, peaks, world_of
from flashdex.system.jsonl import read_lines, read_object
from flashdex.system.machine import describe_commit, describe_hardware


def summarise(run_dir: Path) -> dict[str, object]:
    """Counters at the end and the first pass of every motion of ``run_dir``."""
    last = read_lines(run_dir / "metrics.jsonl")[-1]
    baselines = read_object(run_dir, "baselines.json")
    run = load_run(run_dir)
    facts = motion_facts(run)
    strict = {f.name: f.strict for f in facts}
    conversions: dict[str, object] = {}
    for line in read_lines(run_dir / "conversions.jsonl"):
        if line["converted"] and line["motion"] not in conversions:
            kept = ("env_steps", "wall_s", "core_s", "errors", "certified")
            kept += ("verdict", "trivial", "lift_ratio")
            passed, worst = strict[line["motion"]]
            found = {key: line.get(key) for key in kept}
            found |= {"strict": passed, "worst_frame_m": worst}
            conversions[line["motion"]] = found
    return {
        "world": world_of(run.recipe),
        "env_steps": last["env_steps"],
        "minutes": round(60 * last["hours"], 2),
        "updates": last.get("updates"),
        "core_s": last.get("search/core_s"),
        "converted": len(conversions),
        "motions": len(baselines["frozen_object"]),
        "certified": last["convert/certified"],
        "robust": last["convert/robust"],
        "strict": count(facts)["strict"],
        "median_max": peaks(facts),
        "last_attempts_passing": last["convert/last"],
        "conversions": conversions,
        "baselines": {
            name: {
                m: row["errors"] | {"state": row["state"]} for m, row in rows.items()
            }
            for name, rows in baselines.items()
        },
    }


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--command", required=True, help="that started the run")
    parser.add_argument("--note", required=True, help="state of the machine")
    args = parser.parse_args()
    head = {
        "benchmark": args.run.name,
        "command": args.command,
        "note": args.note,
        "hardware": describe_hardware(),
        "summarised_at_commit": describe_commit(),
    }
    print(json.dumps(head | summarise(args.run), indent=1))


if __name__ == "__main__":
    main()
