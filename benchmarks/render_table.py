"""Render tables of docs/benchmarks.md from the JSON lines in benchmarks/results.

    python -m benchmarks.render_table benchmarks/results/h200_*.jsonl
    python -m benchmarks.render_table FILE ... --into docs/benchmarks.md --name h200

Every number stands in a line of a file; nothing is typed by hand. With `--into` the
text between `<!-- table NAME -->` and `<!-- end -->` is replaced.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

Line = dict[str, Any]
# keys of the columns by benchmark; a key may lead into a mapping with dots
COLUMNS = {
    "env": "engine num_envs objects hulls env_steps_per_s physics_env_steps_per_s "
    "ratio nacon nefc overflow memory_gb.device_used",
    "train": "engine num_envs env_steps_per_s updates_per_s share_of_physics "
    "share_of_learner share_of_both overflow memory_gb.device_used",
    "learner": "size precision gflop_per_update updates_per_s_eager "
    "share_of_ceiling_eager updates_per_s_autocast share_of_ceiling_autocast "
    "updates_per_s_compiled updates_per_s_compiled_autocast "
    "share_of_ceiling_compiled_autocast",
    "replay": "replay rows stored_bytes_per_row written_rows_per_s "
    "sampled_rows_per_s assembled_rows_per_s share_of_gather",
    "search": "engine samples worlds horizon hulls samples_per_s "
    "rollout_samples_per_s cpu_samples_per_s ratio gap_mm overflow "
    "memory_gb.device_used",
    "growth": "engine num_envs objects hulls relative_physics relative_env ratio",
    "curve": "hours env_steps perf/env_steps_per_s convert/cumulative "
    "convert/certified",
}
# their headings, where they are not the key
HEADINGS = {
    "num_envs": "worlds",
    "env_steps_per_s": "env steps/s",
    "physics_env_steps_per_s": "physics alone",
    "nacon": "contacts",
    "nefc": "rows, fullest world",
    "memory_gb.device_used": "GB on device",
    "updates_per_s": "updates/s",
    "share_of_physics": "of physics",
    "share_of_learner": "of learner",
    "share_of_both": "of both in turn",
    "precision": "products",
    "gflop_per_update": "TFLOP an update",
    "updates_per_s_eager": "updates/s",
    "share_of_ceiling_eager": "share",
    "updates_per_s_autocast": "bfloat16",
    "share_of_ceiling_autocast": "share",
    "updates_per_s_compiled": "compiled",
    "updates_per_s_compiled_autocast": "compiled bfloat16",
    "share_of_ceiling_compiled_autocast": "share",
    "replay": "where",
    "stored_bytes_per_row": "bytes a row",
    "written_rows_per_s": "written/s",
    "sampled_rows_per_s": "sampled/s",
    "assembled_rows_per_s": "assembled/s",
    "share_of_gather": "of a plain gather",
    "samples_per_s": "samples/s",
    "rollout_samples_per_s": "rollouts alone",
    "cpu_samples_per_s": "MuJoCo C, one core",
    "relative_physics": "physics, a world's step",
    "relative_env": "environment, a world's step",
    "env_steps": "env steps",
    "perf/env_steps_per_s": "env steps/s",
    "convert/cumulative": "converted",
    "convert/certified": "certified",
}
CURVE_LINES = 12  # of a curve, evenly spread, the last one included


def value_of(line: Line, key: str) -> Any:
    """A value by its key, or by keys joined with dots; None where it is absent."""
    if key in line:
        return line[key]
    found: Any = line
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found


def cell(key: str, value: Any) -> str:
    """A value as text of a table."""
    if value is None:
        return ""
    if key == "overflow":
        return ", ".join(f"{n} {k}" for k, n in value.items()) or "none"
    if key == "gflop_per_update":
        return f"{value / 1e3:.3g}"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, int | float) and abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def table(kind: str, lines: Sequence[Line], *, rates: bool = True) -> str:
    """A Markdown table of the lines of one kind of benchmark; a row each.

    Empty columns are left out, without ``rates`` also what is a number a second.
    """
    if kind == "curve" and len(lines) > CURVE_LINES:
        step = (len(lines) - 1) / (CURVE_LINES - 1)
        lines = [lines[round(i * step)] for i in range(CURVE_LINES)]
    keys = [
        key
        for key in COLUMNS[kind].split()
        if any(value_of(line, key) is not None for line in lines)
        and (rates or "_per_s" not in key)
    ]
    rows = [[HEADINGS.get(key, key) for key in keys], ["---"] * len(keys)]
    rows += [[cell(key, value_of(line, key)) for key in keys] for line in lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def render(lines: Sequence[Line], *, rates: bool = True) -> str:
    """All tables of some lines, each with what it was measured on."""
    out = []
    for kind in COLUMNS:
        found = [x for x in lines if x.get("benchmark") == kind]
        good = [x for x in found if "failed" not in x]
        if good:
            out += [f"`{kind}`, {_origin(good)}:", table(kind, good, rates=rates)]
        out += [f"{x['suite']['job']}: {x['failed']}." for x in found if "failed" in x]
    return "\n\n".join(out)


def _origin(lines: Sequence[Line]) -> str:
    """Hardware, versions and commits of some lines."""
    found: dict[str, None] = {}
    for line in lines:
        hardware = line.get("hardware")
        if isinstance(hardware, dict):
            parts = [hardware.get("gpu") or hardware["processor"]]
            parts.append(f"torch {hardware['torch']}")
            if line.get("engine") == "warp":
                parts.append(f"warp {hardware['warp']}")
            found[f"{', '.join(parts)}, commit {line['commit'] or 'unknown'}"] = None
    return "; ".join(found) or "see the file"


def replace_between(text: str, name: str, new: str) -> str:
    """A page with the text between the marks of a table replaced."""
    begin = f"<!-- table {name} -->"
    marks = re.compile(re.escape(begin) + r".*?<!-- end -->", re.DOTALL)
    if not marks.search(text):
        raise SystemExit(
            f"the page has no '{begin}' ... '<!-- end -->'; add both lines"
        )
    return marks.sub(lambda _: f"{begin}\n\n{new}\n\n<!-- end -->", text)


def main() -> None:
    """Print the tables, or put them into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--into", type=Path, metavar="PAGE")
    parser.add_argument("--name", default="h200", help="of the marks in the page")
    parser.add_argument(
        "--ratios", action="store_true", help="no rates: other work ran beside it"
    )
    args = parser.parse_args()
    texts = [path.read_text(encoding="utf-8") for path in args.files]
    lines = [json.loads(x) for text in texts for x in text.splitlines() if x.strip()]
    text = render(lines, rates=not args.ratios)
    if args.into is None:
        print(text)
        return
    page = args.into.read_text(encoding="utf-8")
    args.into.write_text(replace_between(page, args.name, text), encoding="utf-8")


if __name__ == "__main__":
    main()
