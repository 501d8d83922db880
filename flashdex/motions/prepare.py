"""``prepare``: recordings in, motion library out, with a report of every motion."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import multiprocessing
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from flashdex.errors import LibraryError
from flashdex.hands.spec import load_hand
from flashdex.motions.demo import HumanDemo
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import LibraryWriter
from flashdex.motions.objects import ObjectSettings
from flashdex.motions.process import MotionSettings, Prepared, prepare_motion
from flashdex.motions.residuals import RetargetWeights
from flashdex.motions.recording import SourceOptions
from flashdex.motions.sources import list_recordings

PACKAGES = ("torch", "mujoco", "trimesh", "coacd", "numpy", "scipy")


def prepare(
    source: str,
    input: str | Path | None = None,
    hand: str = "xhand",
    out: str | Path = "library",
    *,
    control_hz: float = 60.0,
    workers: int = 1,
    limit: int | None = None,
    seed: int = 0,
    objects: ObjectSettings | None = None,
    weights: RetargetWeights | None = None,
    cache_dir: Path | None = None,
    progress: bool | None = None,
) -> MotionLibrary:
    """Prepare a collection of recordings as a motion library.

    Args:
        source: name of a reader: procedural, keypoints.
        input: what it reads. keypoints: a folder or a file. procedural: ``quickstart``,
            ``all``, or kinds separated by commas.
        hand: robot hand.
        out: directory of the library; an older library there is replaced at the end.
        control_hz: frames a second of the references.
        workers: processes.
        limit: at most this many motions.
        seed: of made-up motions.
        objects: how meshes become objects.
        weights: of the retargeting.
        cache_dir: of prepared objects.
        progress: show a bar; by default when standard error is a terminal.

    Returns:
        The library; ``report.csv`` in it has a row for every motion, rejected ones too.

    Raises:
        FlashdexError: unknown names, unreadable input, nothing kept, disk refused.

    Example:
        >>> library = prepare("procedural", out="/tmp/quickstart")  # doctest: +SKIP
        >>> library.num_motions  # doctest: +SKIP
        4
    """
    load_hand(hand)  # refuses an unknown name before anything is read
    options = SourceOptions(path=input, seed=seed, limit=limit)
    demos = [d for r in list_recordings(source, options) for d in r.read()]
    settings = MotionSettings(
        hand=hand,
        control_hz=control_hz,
        objects=objects or ObjectSettings(),
        weights=weights or RetargetWeights(),
        cache_dir=cache_dir,
    )
    hidden = None if progress is None else not progress
    bar = tqdm(
        _run(demos, settings, workers), total=len(demos), disable=hidden, unit="motion"
    )
    prepared = list(bar)
    manifest = {
        "source": source,
        "seed": seed,
        "settings": {
            "objects": asdict(settings.objects),
            "weights": asdict(settings.weights),
        },
        "versions": {p: importlib.metadata.version(p) for p in PACKAGES},
        "quality": dict(Counter(p.row["status"] for p in prepared)),
    }
    writer = LibraryWriter(out, hand=hand, fps=control_hz, manifest=manifest)
    for item in prepared:
        if item.record is not None:
            writer.add(item.record)
    _refuse_empty(prepared, out)
    return MotionLibrary.load(
        writer.write(report=make_report([p.row for p in prepared]))
    )


def _run(
    demos: list[HumanDemo], settings: MotionSettings, workers: int
) -> Iterator[Prepared]:
    if workers <= 1:
        yield from (prepare_motion(demo, settings) for demo in demos)
        return
    # spawn: a fork of a process that runs torch threads can hang
    context = multiprocessing.get_context("spawn")
    single = partial(torch.set_num_threads, 1)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=single) as pool:
        yield from pool.map(partial(prepare_motion, settings=settings), demos)


def _refuse_empty(prepared: list[Prepared], out: str | Path) -> None:
    if any(p.record is not None for p in prepared):
        return
    reasons = [f"  {p.row['motion']}: {p.row['reason']}" for p in prepared[:5]]
    raise LibraryError(
        f"{out}: none of {len(prepared)} motions was kept; no library is written.\n"
        + "\n".join(reasons)
    )


def make_report(rows: list[dict[str, Any]]) -> str:
    """CSV with a row a motion; the columns are motion, status, reason, figures.

    Args:
        rows: of all motions, kept or not.
    """
    figures = dict.fromkeys(key for row in rows for key in row)
    columns = ["motion", "status", "reason"]
    columns += [key for key in figures if key not in columns]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
