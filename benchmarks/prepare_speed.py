"""Seconds a recording of `flashdex prepare`, and what a second worker gains.

    OMP_NUM_THREADS=1 python -m benchmarks.prepare_speed --limit 12

Each number of workers starts with an empty cache, so meshes are decomposed; the last
run repeats the first one from its cache. Prints one JSON line. Needs `flashdex fetch
myodm` once, and an idle machine.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from flashdex.datasets.source import SourceOptions
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.prepare import Order, run_order
from flashdex.system.machine import describe_commit, describe_hardware


def seconds(limit: int, workers: int, folder: Path, cache: Path) -> float:
    """Wall time of one preparation."""
    start = time.perf_counter()
    out = folder / f"library{workers}"
    settings = MotionSettings(cache_dir=cache)
    order = Order("myodm", SourceOptions(limit=limit), settings)
    run_order(order, out, workers=workers)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print; the guard below keeps spawned workers from doing it again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit", type=int, default=12)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        two = seconds(args.limit, 2, folder, folder / "cache2")
        one = seconds(args.limit, 1, folder, folder / "cache1")
        again = seconds(args.limit, 1, folder, folder / "cache1")
    figures = {
        "benchmark": "prepare myodm",
        "recordings": args.limit,
        "s_one_worker": round(one, 1),
        "s_two_workers": round(two, 1),
        "s_from_cache": round(again, 2),
        "s_per_recording": round(one / args.limit, 2),
        "gain_of_second_worker": round(one / two, 2),
        "hardware": describe_hardware(),
        "commit": describe_commit(),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
