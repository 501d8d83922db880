"""``prepare``: recordings in, motion library out, with a report of every motion."""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import io
import json
import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from flashdex.datasets import list_recordings
from flashdex.datasets.source import Recording, SourceOptions, is_named
from flashdex.errors import DemoError, LibraryError
from flashdex.hands.spec import load_hand
from flashdex.motions.findings import reject
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import (
    LibraryWriter,
    MotionRecord,
    check_target,
)
from flashdex.motions.pipeline.cache import cache_file, content_hash, remove_torn
from flashdex.motions.pipeline.motion import MotionSettings, rejected
from flashdex.motions.pipeline.workers import Job, Outcome, run_jobs
from flashdex.system.names import file_stem, plain_name

FORMULAS = ("=", "+", "-", "@", "\t", "\r")  # what begins one in a spreadsheet
_LOG = logging.getLogger(__name__)

PACKAGES = ("torch", "mujoco", "trimesh", "coacd", "numpy", "scipy")


@dataclass(frozen=True)
class Order:
    """What is to be prepared, and how."""

    source: str  # name of a reader, see ``flashdex.datasets.source_names``
    options: SourceOptions = field(default_factory=SourceOptions)
    settings: MotionSettings = field(default_factory=MotionSettings)
    enough: int | None = None  # motions that are kept; what comes after is not prepared

    def recordings(self) -> list[Recording]:
        """The recordings, listed but not read."""
        return list_recordings(self.source, self.options)


def run_order(
    order: Order,
    out: str | Path,
    *,
    workers: int = 1,
    ray: bool = False,
    progress: bool | None = None,
) -> MotionLibrary:
    """Prepare a collection of recordings as a motion library.

    What was prepared before, with the same content, settings and code, comes from the
    cache: an interrupted preparation goes on where it was.

    An older library in ``out`` is replaced at the end. A Ray cluster may take the place
    of processes; a bar is shown by default when standard error is a terminal.

    Returns:
        The library; ``report.csv`` in it has a row for every motion, rejected ones too.

    Raises:
        FlashdexError: unknown names, unreadable input, nothing kept, disk refused.

    Example:
        >>> library = run_order(Order("procedural"), "/tmp/made")  # doctest: +SKIP
        >>> library.num_motions  # doctest: +SKIP
        4
    """
    settings = order.settings
    # refused before anything is read
    load_hand(settings.hand)
    check_target(Path(out))
    remove_torn(settings.cache_root)
    listed = order.recordings()
    recordings, doubles = _without_doubles(listed)
    jobs = [Job(recording, settings) for recording in recordings]
    _tell_start(jobs, workers)
    how = {"workers": workers, "ray": ray, "progress": progress}
    outcomes = _run_enough(jobs, order, **how)
    rows = [row for outcome in outcomes for row in outcome.rows] + doubles
    writer = LibraryWriter(
        out,
        hand=settings.hand,
        fps=settings.control_hz,
        manifest=_facts(order, listed, rows),
    )
    for record in _records(outcomes, settings.cache_root):
        writer.add(record)
    _refuse_empty(rows, out)
    return MotionLibrary.load(writer.write(report=make_report(rows)))


def _run_enough(jobs: list[Job], order: Order, **how: Any) -> list[Outcome]:
    """Outcomes of all jobs, or of as many, in their order, as keep enough motions."""
    outcomes: list[Outcome] = []
    patterns = order.options.select or ("*",)
    missing = len(jobs) if order.enough is None else order.enough
    while missing > 0 and len(outcomes) < len(jobs):
        new = run_jobs(jobs[len(outcomes) :][:missing], **how)
        outcomes += new
        rows = [row for outcome in new for row in outcome.rows]
        kept = [row["motion"] for row in rows if row["status"] != "rejected"]
        missing -= sum(any(is_named(name, p) for p in patterns) for name in kept)
    return outcomes


def _tell_start(jobs: list[Job], workers: int) -> None:
    if workers < 1:
        raise DemoError(f"--workers is {workers}; at least 1 is needed.")
    root = jobs[0].settings.cache_root
    known = 0
    for job in jobs:
        with suppress(OSError):
            known += cache_file(job.recording, job.settings).is_file()
    left = len(jobs) - known
    more = (
        f", {left} to do; a new mesh takes seconds, a hard one a minute" if left else ""
    )
    text = "%d of %d recordings are in the cache %s%s"
    _LOG.info(text, known, len(jobs), root, more)


def hash_inputs(order: Order, listed: list[Recording] | None = None) -> str:
    """SHA-256 of the recordings' content and the settings, not of the code."""
    text = json.dumps(order.settings.facts(), sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for recording in order.recordings() if listed is None else listed:
        digest.update(recording.name.encode())
        with suppress(OSError):  # a file that cannot be read has no content
            digest.update(content_hash(recording).encode())
    return digest.hexdigest()


def _without_doubles(
    recordings: list[Recording],
) -> tuple[list[Recording], list[dict[str, Any]]]:
    """Recordings whose content comes once, and report rows of the others."""
    kept: dict[str, Recording] = {}
    rows = []
    for recording in recordings:
        try:
            key = content_hash(recording) if recording.files else recording.name
        except OSError:
            key = recording.name  # its worker says what cannot be read
        first = kept.setdefault(key, recording)
        if first is not recording:
            double = reject("I_DUP", f"the same content as '{first.name}'")
            rows.append(rejected(recording.name, [double]).row)
    return list(kept.values()), rows


def _facts(
    order: Order, listed: list[Recording], rows: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "source": order.source,
        "seed": order.options.seed,
        "settings": order.settings.facts(),
        "inputs": hash_inputs(order, listed),
        "versions": {p: importlib.metadata.version(p) for p in PACKAGES},
        "quality": dict(Counter(row["status"] for row in rows)),
    }


def _records(outcomes: list[Outcome], root: Path) -> Iterator[MotionRecord]:
    """Kept motions, one in memory at a time; names that would meet get a number."""
    taken: set[str] = set()
    for outcome in outcomes:
        for item, row in zip(outcome.load(root), outcome.rows, strict=True):
            if item.record is None:
                continue
            name = _free_name(item.record.name, taken)
            item.record, row["motion"] = replace(item.record, name=name), name
            yield item.record


def _free_name(wanted: str, taken: set[str]) -> str:
    """A name whose files are those of no other, on any file system."""
    name, count = plain_name(wanted), 1
    while (stem := file_stem(name).casefold()) in taken:
        count += 1
        name = f"{plain_name(wanted, limit=240)}_{count}"
    taken.add(stem)
    return name


def _refuse_empty(rows: list[dict[str, Any]], out: str | Path) -> None:
    if any(row["status"] != "rejected" for row in rows):
        return
    reasons = [f"  {row['motion']}: {row['reason']}" for row in rows[:5]]
    raise LibraryError(
        f"{out}: none of {len(rows)} motions was kept; no library is written.\n"
        + "\n".join(reasons)
    )


def make_report(rows: list[dict[str, Any]]) -> str:
    """CSV with a row a motion, kept or not: motion, status, reason, then figures."""
    first = ("motion", "status", "reason")
    columns = dict.fromkeys([*first, *(key for row in rows for key in row)])
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: _harmless(v) for k, v in row.items()} for row in rows)
    return text.getvalue()


def _harmless(value: Any) -> Any:
    """A text that a spreadsheet does not take for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in FORMULAS else value
