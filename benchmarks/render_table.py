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
# heading and key of each column; a key may lead into a mapping with dots
COLUMNS: dict[str, list[tuple[str, str]]] = {
    "env": [
        ("engine", "engine"),
        ("worlds", "num_envs"),
        ("objects", "objects"),
        ("hulls", "hulls"),
        ("env steps/s", "env_steps_per_s"),
        ("physics alone", "physics_env_steps_per_s"),
        ("ratio", "ratio"),
        ("contacts", "nacon"),
        ("rows, fullest world", "nefc"),
        ("overflow", "overflow"),
        ("GB on device", "memory_gb.device_used"),
    ],
    "train": [
        ("engine", "engine"),
        ("worlds", "num_envs"),
        ("env steps/s", "env_steps_per_s"),
        ("updates/s", "updates_per_s"),
        ("of physics", "share_of_physics"),
        ("of learner", "share_of_learner"),
        ("of both in turn", "share_of_both"),
        ("overflow", "overflow"),
        ("GB on device", "memory_gb.device_used"),
    ],
    "learner": [
        ("size", "size"),
        ("products", "precision"),
        ("TFLOP an update", "gflop_per_update"),
        ("updates/s", "updates_per_s_eager"),
        ("share", "share_of_ceiling_eager"),
        ("bfloat16", "updates_per_s_autocast"),
        ("share", "share_of_ceiling_autocast"),
        ("compiled", "updates_per_s_compiled"),
        ("compiled bfloat16", "updates_per_s_compiled_autocast"),
        ("share", "share_of_ceiling_compiled_autocast"),
    ],
    "replay": [
        ("where", "replay"),
        ("rows", "rows"),
        ("bytes a row", "stored_bytes_per_row"),
        ("written/s", "written_rows_per_s"),
        ("sampled/s", "sampled_rows_per_s"),
        ("assembled/s", "assembled_rows_per_s"),
        ("of a plain gather", "share_of_gather"),
    ],
    "growth": [
        ("engine", "engine"),
        ("worlds", "num_envs"),
        ("objects", "objects"),
        ("hulls", "hulls"),
        ("physics, a world's step", "relative_physics"),
        ("environment, a world's step", "relative_env"),
        ("ratio", "ratio"),
    ],
    "curve": [
        ("hours", "hours"),
        ("env steps", "env_steps"),
        ("env steps/s", "perf/env_steps_per_s"),
        ("converted", "convert/cumulative"),
        ("certified", "convert/certified"),
    ],
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
    """A Markdown table of the lines of one kind; empty columns are left out.

    Args:
        kind: of benchmark.
        lines: a row each.
        rates: False leaves out what is a number a second.
    """
    if kind == "curve" and len(lines) > CURVE_LINES:
        step = (len(lines) - 1) / (CURVE_LINES - 1)
        lines = [lines[round(i * step)] for i in range(CURVE_LINES)]
    columns = [
        (head, key)
        for head, key in COLUMNS[kind]
        if any(value_of(line, key) is not None for line in lines)
        and (rates or "_per_s" not in key)
    ]
    rows = [[head for head, _ in columns], ["---"] * len(columns)]
    rows += [[cell(key, value_of(x, key)) for _, key in columns] for x in lines]
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


def read_lines(paths: Sequence[Path]) -> list[Line]:
    """The JSON objects of some files, in order."""
    texts = [path.read_text(encoding="utf-8") for path in paths]
    return [json.loads(x) for text in texts for x in text.splitlines() if x.strip()]


def replace_between(text: str, name: str, new: str) -> str:
    """A page with the text between the marks of a table replaced.

    Raises:
        SystemExit: the page has no such marks.
    """
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
    text = render(read_lines(args.files), rates=not args.ratios)
    if args.into is None:
        print(text)
        return
    page = args.into.read_text(encoding="utf-8")
    args.into.write_text(replace_between(page, args.name, text), encoding="utf-8")


if __name__ == "__main__":
    main()
