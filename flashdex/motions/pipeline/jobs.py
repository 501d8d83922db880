"""One recording after another, each found in the cache or prepared into it.

This is what a worker process does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flashdex.datasets.source import Recording
from flashdex.errors import LibraryError
from flashdex.motions.findings import of_error, reject
from flashdex.motions.pipeline.cache import cache_file, read_prepared, write_prepared
from flashdex.motions.pipeline.motion import (
    MotionSettings,
    Prepared,
    prepare_recording,
    rejected,
)


@dataclass(frozen=True)
class Job:
    """What a worker is given: a recording and how to prepare it."""

    recording: Recording
    settings: MotionSettings


@dataclass(frozen=True)
class Outcome:
    """What a worker gives back; the motions stay on the disk where that is possible."""

    rows: list[dict[str, Any]]  # of the report, one a motion
    file: Path | None  # that keeps the motions, if they could be kept
    prepared: list[Prepared]  # the motions themselves, if not

    def load(self, root: Path) -> list[Prepared]:
        """The motions.

        Args:
            root: of the cache.

        Raises:
            LibraryError: they were kept on the disk and are gone.
        """
        stored = None if self.file is None else read_prepared(self.file, root)
        if stored is None and len(self.prepared) < len(self.rows):
            raise LibraryError(
                f"{self.file}: what a worker kept here cannot be read any more. All "
                f"workers need the same cache folder, and nobody may clean it "
                f"meanwhile. Start again: what is there is not prepared again."
            )
        return self.prepared if stored is None else stored


def run_job(job: Job, *, carry: bool = False) -> Outcome:
    """Prepare one recording, or find it prepared; never raises for its content.

    Args:
        job: the recording and how.
        carry: bring the motions along, for a caller that may not see this disk.
    """
    root = job.settings.cache_root
    try:
        file = cache_file(job.recording, job.settings)
    except OSError as error:
        item = rejected(job.recording.name, [of_error(error)])
        return Outcome([item.row], None, [item])
    prepared = read_prepared(file, root)
    is_kept = prepared is not None
    if prepared is None:
        prepared = prepare_recording(job.recording, job.settings)
        write_prepared(file, prepared)
        # a disk that refuses the motions or their objects must not cost them
        is_kept = not carry and read_prepared(file, root) is not None
    rows = [item.row for item in prepared]
    return Outcome(rows, file, [] if is_kept and not carry else prepared)


def crashed(job: Job) -> Outcome:
    """The outcome of a job whose worker died."""
    text = "the worker process died (out of memory, or a crash in a mesh library)"
    item = rejected(job.recording.name, [reject("E_CRASH", text)])
    return Outcome([item.row], None, [item])
