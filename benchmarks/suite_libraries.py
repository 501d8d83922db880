"""Prepares what the device suite needs, once, on any computer; no GPU is used.

    python -m benchmarks.suite_libraries libraries/suite --workers 2
    python -m benchmarks.suite_libraries libraries/suite --pack suite.tar.xz

The suite then needs no network, no CoACD and no retargeting: it takes the folder, or
the archive, which is a fifth of its size.
"""

from __future__ import annotations

import argparse
import json
import tarfile
import time
from pathlib import Path

from benchmarks.common.library import bench_library
from benchmarks.device_suite import CURVE_LIBRARY
from flashdex.datasets.source import SourceOptions
from flashdex.motions.pipeline.prepare import Order, run_order

SCENES = ((2, 16), (2, 1), (2, 4), (2, 8), (1, 16), (1, 1))
CURVE_MOTIONS = 50


def make_libraries(folder: Path, *, workers: int) -> dict[str, float]:
    """Prepare what is missing with so many processes; seconds by library."""
    spent = {}
    for objects, hulls in SCENES:
        begin = time.perf_counter()
        path = bench_library(objects, hulls, folder=folder)
        spent[path.name] = round(time.perf_counter() - begin, 1)
    curve = folder / CURVE_LIBRARY
    if not (curve / "manifest.json").is_file():
        begin = time.perf_counter()
        options = SourceOptions(path=Path("all"), limit=CURVE_MOTIONS)
        run_order(Order("procedural", options), curve, workers=workers)
        spent[curve.name] = round(time.perf_counter() - begin, 1)
    return spent


def pack(folder: Path, archive: Path) -> Path:
    """Write the libraries into a compressed archive; pictures stay out."""
    with tarfile.open(archive, "w:xz", preset=6) as file:
        for path in sorted(folder.iterdir()):
            if not path.name.endswith("-base"):
                file.add(path, path.name)
    return archive


def main() -> None:
    """Prepare, pack, and print one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--pack", type=Path, metavar="FILE.tar.xz")
    args = parser.parse_args()
    spent = make_libraries(args.folder, workers=args.workers)
    line = {"benchmark": "suite_libraries", "workers": args.workers, "seconds": spent}
    if args.pack is not None:
        line["archive_mb"] = round(pack(args.folder, args.pack).stat().st_size / 1e6, 1)
    print(json.dumps(line))


if __name__ == "__main__":
    main()
