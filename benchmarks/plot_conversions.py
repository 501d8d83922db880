"""Draw conversions over core-minutes, of runs summarised in benchmarks/results.

    python -m benchmarks.plot_conversions policy=FILE search=FILE --out docs/a.svg

Core-seconds of a search are counted; those of a training are its seconds times the
cores of the machine, which it keeps busy. Trivial conversions count for neither.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

from flashdex.reports.chart import Series, line_chart

STYLE = (
    "svg{font:11px sans-serif;background:#fff}.t{font-weight:600}.g{stroke:#ddd}"
    ".a{stroke:#555}.c{fill:none;stroke-width:2}"
)


def curve(name: str, summary: dict) -> Series:
    """Motions converted by when, core-minutes, to the end of the run."""
    cores = int(re.findall(r"(\d+) cores", summary["hardware"])[0])
    end = summary.get("core_s") or 60 * cores * summary["minutes"]
    spent = sorted(
        found.get("core_s") or cores * found["wall_s"]
        for found in summary["conversions"].values()
        if not found["trivial"]
    )
    counts = [*range(len(spent) + 1), len(spent)]
    return Series(name, [x / 60 for x in (0.0, *spent, end)], counts)


def main() -> None:
    """Read the command line, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", metavar="LABEL=FILE")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    found = []
    for word in args.runs:
        label, file = word.split("=", 1)
        found.append((label, json.loads(Path(file).read_text(encoding="utf-8"))))
    total = max(summary["motions"] for _, summary in found)
    chart = line_chart(
        [curve(label, summary) for label, summary in found],
        title="Motions",
        x_label="core-minutes",
        is_step=True,
        y_range=(0.0, float(total)),
    )
    head = '<svg xmlns="http://www.w3.org/2000/svg" '
    text = str(chart).strip().replace("<svg ", head, 1)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text.replace(">", f"><style>{STYLE}</style>", 1) + "\n")


if __name__ == "__main__":
    main()
