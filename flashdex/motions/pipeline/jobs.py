"""One recording after another: read, repair, cut, prepare; nothing raises.

This is what a worker process does. Whatever is wrong with a recording becomes a
rejected row of the report, so that one bad file never costs the others.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from flashdex.datasets.demo import MAX_SECONDS, HumanDemo
from flashdex.datasets.source import Recording
from flashdex.errors import DemoError, LibraryError, MeshError
from flashdex.motions.checks.recording import Finding, concerning
from flashdex.motions.pipeline.cache import cache_file, read_prepared, write_prepared
from flashdex.motions.pipeline.motion import (
    MotionSettings,
    Prepared,
    prepare_motion,
    reject,
)
from flashdex.motions.repair.repair import repair
from flashdex.motions.repair.segment import segment

logger = logging.getLogger(__name__)

WARNINGS = ("W_", "E_")  # a reader that goes on after an error has repaired it


@dataclass(frozen=True)
class Job:
    """What a worker is given: a recording and how to prepare it."""

    recording: Recording
    settings: MotionSettings


@dataclass(frozen=True)
class Outcome:
    """What a worker gives back; the motions stay on the disk where that is possible.

    Attributes:
        rows: of the report, one a motion.
        file: that keeps the motions, if they could be kept.
        prepared: the motions themselves, if not.
    """

    rows: list[dict[str, Any]]
    file: Path | None
    prepared: list[Prepared]

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
        rejected = _reject(job.recording.name, "E_FILE", f"cannot be read: {error}")
        return Outcome([rejected.row], None, [rejected])
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
    rejected = _reject(job.recording.name, "E_CRASH", text)
    return Outcome([rejected.row], None, [rejected])


def prepare_recording(recording: Recording, settings: MotionSettings) -> list[Prepared]:
    """All motions of a recording, rejected ones too.

    Args:
        recording: listed by a source.
        settings: how.
    """

    def read_all() -> list[Prepared]:
        demos = recording.read()
        return [item for demo in demos for item in prepare_demo(demo, settings)]

    return _guard(recording.name, read_all)


def prepare_demo(demo: HumanDemo, settings: MotionSettings) -> list[Prepared]:
    """Repair a demonstration, cut it if it is to be cut, prepare every piece.

    Args:
        demo: as read.
        settings: how.
    """
    return _guard(demo.name, partial(_prepare_pieces, demo, settings))


def _prepare_pieces(demo: HumanDemo, settings: MotionSettings) -> list[Prepared]:
    demo = _paced(demo, settings.speed)
    demo.validate(complete=False)
    is_cut = _is_cut(demo, settings)
    pieces, findings = repair(demo, keep_gaps=is_cut)
    findings += _notes(demo)
    if is_cut and pieces:
        pieces, remarks = segment(pieces[0])
        findings += remarks
    if not pieces:
        return [reject(demo.name, findings)]
    return [item for p in pieces for item in _prepare_piece(p, settings, findings)]


def _prepare_piece(
    piece: HumanDemo, settings: MotionSettings, findings: list[Finding]
) -> list[Prepared]:
    told = concerning(findings, piece)
    return _guard(piece.name, lambda: [prepare_motion(piece, settings, told)])


def _guard(name: str, make: Callable[[], list[Prepared]]) -> list[Prepared]:
    """What one step makes; what goes wrong in it costs nothing but this step."""
    try:
        return make()
    except (DemoError, MeshError) as error:
        other = "E_MESH" if isinstance(error, MeshError) else "E_DEMO"
        return [_reject(name, error.code or other, error.text)]
    except OSError as error:  # a name too long, a folder that may not be entered
        return [_reject(name, "E_FILE", f"cannot be read: {error}")]
    except Exception as error:  # what no check foresaw must not end the others
        logger.debug("%s", name, exc_info=True)
        return [_reject(name, "E_READ", f"unforeseen {type(error).__name__}: {error}")]


def _notes(demo: HumanDemo) -> list[Finding]:
    """Remarks of the reader: ``CODE: text``."""
    found = []
    for note in demo.provenance.get("notes", []):
        code, _, text = str(note).partition(": ")
        found.append(Finding(code, "warn" if code[:2] in WARNINGS else "info", text))
    return found


def _paced(demo: HumanDemo, speed: float) -> HumanDemo:
    if speed == 1.0:
        return demo
    told = demo.provenance | {"speed": speed}
    return replace(demo, fps=demo.fps * speed, provenance=told)


def _is_cut(demo: HumanDemo, settings: MotionSettings) -> bool:
    if settings.cut == "never":
        return False
    long = demo.seconds > MAX_SECONDS
    return demo.needs_cutting or long or settings.cut == "always"


def _reject(name: str, code: str, text: str) -> Prepared:
    return reject(name, [Finding(code, "reject", text)])
