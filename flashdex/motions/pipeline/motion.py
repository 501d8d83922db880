"""From a recording to library motions, stage by stage; nothing raises.

    recording -> repair -> (segment) -> align -> roles -> retarget -> checks -> record

Each stage is a function that takes what the former one returned. Whatever is wrong with
a recording, one of its motions or a piece of one becomes a rejected row of the report
and costs nothing else.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flashdex.datasets.demo import MAX_SECONDS, HumanDemo
from flashdex.datasets.source import Recording
from flashdex.errors import DemoError, MeshError, is_of_machine
from flashdex.hands.spec import load_hand
from flashdex.keys import SIDES
from flashdex.motions.align import align
from flashdex.motions.checks.aligned import check_aligned, check_reference
from flashdex.motions.checks.recording import check_demo, check_sides
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.findings import (
    Finding,
    concerning,
    make_strict,
    of_error,
    of_reader,
    reason_of,
    status_of,
)
from flashdex.motions.frames import make_record
from flashdex.motions.library_writer import MotionRecord
from flashdex.motions.pipeline.stage import tell
from flashdex.motions.repair.objects import settle_objects
from flashdex.motions.repair.repair import repair
from flashdex.motions.repair.segment import segment
from flashdex.motions.retarget.residuals import RetargetWeights
from flashdex.motions.retarget.solver import retarget
from flashdex.objects.asset import ObjectSettings, default_cache_dir, make_object
from flashdex.objects.solid import make_slot_grid

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MotionSettings:
    """How motions are prepared.

    Recordings are cut where contact begins and ends: with ``cut="auto"`` sessions and
    what lasts too long, with ``"never"`` every recording is taken as it is.
    """

    hand: str = "xhand"  # robot hand
    control_hz: float = 60.0  # frames a second of the references
    objects: ObjectSettings = field(default_factory=ObjectSettings)
    weights: RetargetWeights = field(default_factory=RetargetWeights)
    attempts: int = 6  # of the inverse kinematics at most; the best one is kept
    cut: Literal["auto", "always", "never"] = "auto"
    speed: float = 1.0  # of playback; 0.5 makes every motion last twice as long
    strict: bool = False  # reject what would be flagged
    cache_dir: Path | None = None  # of objects and motions; by default the user's

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        if not self.control_hz > 0 or not self.speed > 0:
            raise DemoError(
                f"control rate {self.control_hz:g} and speed {self.speed:g} must be "
                f"positive (--hz, --speed)."
            )

    @property
    def cache_root(self) -> Path:
        """Folder of the cache."""
        return self.cache_dir or default_cache_dir()

    def facts(self) -> dict[str, Any]:
        """All that decides the result: everything but the place of the cache."""
        return {k: v for k, v in asdict(self).items() if k != "cache_dir"}


@dataclass
class Prepared:
    """Outcome of one motion: its record unless rejected, and its row of the report."""

    record: MotionRecord | None
    row: dict[str, Any]
    passing: bool = False  # no fault of the recording: another time it may go well


def prepare_recording(recording: Recording, settings: MotionSettings) -> list[Prepared]:
    """All motions of a listed recording, rejected ones too."""

    def read_all() -> list[Prepared]:
        tell(recording.name, "reading")
        demos = recording.read()
        return [item for demo in demos for item in prepare_demo(demo, settings)]

    return _guard(recording.name, read_all)


def prepare_demo(demo: HumanDemo, settings: MotionSettings) -> list[Prepared]:
    """Repair a demonstration, cut it if it is to be cut, prepare every piece."""
    return _guard(demo.name, lambda: _prepare_pieces(demo, settings))


def _prepare_pieces(demo: HumanDemo, settings: MotionSettings) -> list[Prepared]:
    if settings.speed != 1.0:
        told = demo.provenance | {"speed": settings.speed}
        demo = replace(demo, fps=demo.fps * settings.speed, provenance=told)
    demo, remarks = settle_objects(demo)
    demo.validate(complete=False)
    long = demo.needs_cutting or demo.seconds > MAX_SECONDS
    is_cut = settings.cut == "always" or (settings.cut == "auto" and long)
    pieces, findings = repair(demo, keep_gaps=is_cut)
    findings += remarks + of_reader(demo)
    if is_cut and pieces:
        pieces, remarks = segment(pieces[0])
        findings += remarks
    if not pieces:
        return [rejected(demo.name, findings)]

    def prepare(piece: HumanDemo) -> list[Prepared]:
        return [prepare_motion(piece, settings, concerning(findings, piece))]

    return [i for p in pieces for i in _guard(p.name, lambda p=p: prepare(p))]


def _guard(name: str, make: Callable[[], list[Prepared]]) -> list[Prepared]:
    """What one step makes; what goes wrong in it costs nothing but this step."""
    try:
        return make()
    except Exception as error:  # what no check foresaw must not end the others
        logger.debug("%s", name, exc_info=True)
        item = rejected(name, [of_error(error)])
        # libraries tell want of memory or threads in words of their own
        foreseen = isinstance(error, DemoError | MeshError)
        passing = not foreseen or is_of_machine(error)
        return [replace(item, passing=passing)]


def rejected(name: str, findings: list[Finding]) -> Prepared:
    """A motion, or a whole recording, that is not prepared at all."""
    row = {"motion": name, "status": "rejected", "reason": reason_of(findings)}
    return Prepared(None, row)


def prepare_motion(
    demo: HumanDemo, settings: MotionSettings, findings: list[Finding] | None = None
) -> Prepared:
    """Prepare one motion; a fault of the recording becomes a rejected row.

    The findings are remarks from earlier steps.
    """
    row: dict[str, Any] = {"motion": demo.name}
    findings = list(findings or [])
    record = None
    try:
        record = _prepare(demo, settings, findings, row)
    except (DemoError, MeshError) as error:
        findings.append(of_error(error))
    if settings.strict:
        findings = make_strict(findings)
    row["source"], row["split"], row["task"] = demo.source, demo.split, demo.task
    row["status"] = status_of(findings)
    row["reason"] = reason_of(findings)
    if row["status"] == "rejected" or record is None:
        return Prepared(None, row)
    record.info |= {"status": row["status"], "reason": row["reason"]}
    return Prepared(record, row)


def _prepare(
    demo: HumanDemo, settings: MotionSettings, findings: list[Finding], row: dict
) -> MotionRecord | None:
    """The stages of one motion; they add to the findings and to its row."""
    demo.validate()
    findings += check_demo(demo) + check_sides(demo)
    if status_of(findings) == "rejected":
        return None
    motion = find_roles(align(demo, control_hz=settings.control_hz))
    assets = []
    for m, n in zip(motion.meshes, motion.object_names, strict=True):
        tell(demo.name, f"mesh of {n}")
        cache = settings.cache_dir
        asset = make_object(m, settings=settings.objects, cache_dir=cache, name=n)
        assets.append(asset)
    tell(demo.name, "contact")
    found, figures = check_aligned(motion, assets, make_slot_grid(assets, solid=False))
    findings += found
    row |= figures
    if status_of(findings) == "rejected":
        return None
    specs = load_hand(settings.hand)
    tell(demo.name, f"joints of {settings.hand}")
    choice, targets = retarget(
        motion, assets, specs, weights=settings.weights, attempts=settings.attempts
    )
    ranges = np.stack([specs[side].joint_range for side in SIDES])
    found, figures = check_reference(motion, choice.best, ranges)
    findings += found
    row |= figures
    return make_record(demo, motion, assets, choice, targets)
