"""One JSON object a measurement: to the standard output, and to a file of lines."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from flashdex.system.machine import describe_commit, describe_machine


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--json`` and ``--out`` to the options of a benchmark.

    Args:
        parser: of the benchmark.
    """
    parser.add_argument("--json", action="store_true", help="always so")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="also append the line to this file"
    )


def emit(result: dict[str, Any], *, out: Path | None = None) -> dict[str, Any]:
    """Print a result with hardware and commit, and append it to a file.

    Args:
        result: what was measured.
        out: file of JSON lines, or None.

    Returns:
        The printed object.
    """
    whole = {**result, "hardware": describe_machine(), "commit": describe_commit()}
    line = json.dumps(whole) + "\n"
    sys.stdout.write(line)
    sys.stdout.flush()
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a", encoding="utf-8") as file:
            file.write(line)
    return whole
