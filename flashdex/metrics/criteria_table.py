"""Every named success criterion as a row of one table.

A criterion is a set of terms. A term takes one error per hand, reduces it over the
scored frames, then over the hands, and compares it with a limit. ``criteria.score``
applies the rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from types import MappingProxyType
from typing import Any, Literal, get_args

from flashdex.errors import UnknownNameError
from flashdex.keys import SIDES, Side

ALIASES = {"sr_spider": "sr_spider_centred"}

Quantity = Literal[
    "object_pos",
    "object_pos_centred",
    "object_rot",
    "lift",
    "path",
    "fingertip",
    "joint",
    "wrist_pos",
]
TimeReduction = Literal["mean", "max", "p95"]
HandReduction = Literal["worst", "mean"]
Family = Literal["mt", "spider", "chord", "completed"]


@dataclass(frozen=True)
class Limits:
    """Limits of the criteria; metres, radians, and shares for ``lift`` and ``path``."""

    object_pos: float = 0.03
    object_rot: float = math.radians(30)
    fingertip: float = 0.06
    joint: float = 0.08
    loose_pos: float = 0.10
    lift: float = 0.25  # .8 to 1.25 of the rise of the reference
    path: float = 0.50  # 2/3 to 1.5 of its path; a held object trembles
    spider_pos: float = 0.10
    spider_rot: float = 0.5
    chord_wrist: float = 0.15
    chord_pos: float = 0.10
    chord_rot: float = 0.5


@dataclass(frozen=True)
class Term:
    """One error, its reductions over frames and hands, and its limit.

    Limits are m or rad; of ``lift`` and ``path`` the share by which the ratio of
    simulated to reference may differ from 1, up or down.
    """

    quantity: Quantity
    limit: float
    time: TimeReduction = "mean"
    hands: HandReduction = "worst"
    strict: bool = False

    @property
    def is_of_object(self) -> bool:
        """It is of a hand's object, not of the hand."""
        return self.quantity.startswith("object") or self.quantity in ("lift", "path")


@dataclass(frozen=True)
class Criterion:
    """A named set of terms that must all hold."""

    name: str
    terms: tuple[Term, ...]
    family: Family
    grace: int
    drop_static: bool = False


def _maniptrans_terms(
    limits: Limits,
    *,
    hand: bool,
    scale: float = 1.0,
    time: TimeReduction = "mean",
    strict: bool = False,
) -> tuple[Term, ...]:
    objects: tuple[Quantity, ...] = ("object_pos", "object_rot")
    tips: tuple[Quantity, ...] = ("fingertip", "joint")
    return tuple(
        Term(name, getattr(limits, name) * scale, time=time, strict=strict)
        for name in (*objects, *(tips if hand else ()))
    )


def _maniptrans(limits: Limits, grace: int) -> Iterable[Criterion]:
    for base, hand in (("sr_mt_obj", False), ("sr_mt", True)):
        for suffix, scale in (("", 1.0), ("_x0.5", 0.5), ("_x2", 2.0)):
            terms = _maniptrans_terms(limits, hand=hand, scale=scale)
            yield Criterion(base + suffix, terms, "mt", grace)
        terms = _maniptrans_terms(limits, hand=hand, time="max")
        yield Criterion(f"{base}_frame", terms, "mt", grace)
    # A mean of 3 cm lets an object stay where it is while the reference rises by less
    # than 6 cm. This one asks for the movement as well.
    moved = (Term("lift", limits.lift), Term("path", limits.path))
    terms = (*_maniptrans_terms(limits, hand=False), *moved)
    yield Criterion("sr_mt_obj_moved", terms, "mt", grace)
    terms = _maniptrans_terms(limits, hand=False, time="p95")
    yield Criterion("sr_mt_obj_p95", terms, "mt", grace)
    loose = replace(limits, object_pos=limits.loose_pos)
    yield Criterion("sr_loose", _maniptrans_terms(loose, hand=False), "mt", grace)
    # FlashCHORD's port: strict, whole clip
    terms = _maniptrans_terms(limits, hand=False, strict=True)
    yield Criterion("sr_mt_obj_flashchord", terms, "mt", 0)


def _spider(limits: Limits) -> Iterable[Criterion]:
    rules: tuple[tuple[str, Quantity, HandReduction, bool], ...] = (
        ("centred", "object_pos_centred", "mean", False),
        ("raw", "object_pos", "mean", True),
        ("worst", "object_pos", "worst", True),
        # FlashCHORD's evaluator: raw, <=, static objects counted
        ("flashchord", "object_pos", "mean", False),
    )
    for name, pos, hands, strict in rules:
        terms = (
            Term(pos, limits.spider_pos, hands=hands, strict=strict),
            Term("object_rot", limits.spider_rot, hands=hands, strict=strict),
        )
        drop = name != "flashchord"
        yield Criterion(f"sr_spider_{name}", terms, "spider", 0, drop_static=drop)


def make_criteria(*, limits: Limits | None = None, grace: int = 15) -> list[Criterion]:
    """The table of criteria.

    Args:
        limits: other limits than the published ones.
        grace: first steps the ManipTrans family does not score; the others score all.
    """
    limits = limits or Limits()
    chord = (
        Term("wrist_pos", limits.chord_wrist, time="max"),
        Term("object_pos", limits.chord_pos, time="max"),
        Term("object_rot", limits.chord_rot, time="max"),
    )
    return [
        *_maniptrans(limits, grace),
        *_spider(limits),
        Criterion("completed", (), "completed", 0),
        Criterion("chord_sr", chord, "chord", 0),
    ]


def criterion_names() -> list[str]:
    """All names ``score`` returns, per-hand variants included."""
    names = [c.name for c in make_criteria()]
    return [n + s for n in names for s in ("", "_left", "_right")]


def resolve_criterion(name: str) -> str:
    """The full name; ``sr_spider`` is FDR's name for the centred form."""
    full = ALIASES.get(name, name)
    if full not in criterion_names():
        raise UnknownNameError(name, [*criterion_names(), *ALIASES], where="criterion")
    return full


State = Literal["passed", "failed", "not_measured"]
CertificateVerdict = Literal["certified", "robust", "failed", "not_measured"]


@dataclass(frozen=True)
class Blame:
    """One limit that one hand, or the object of one hand, crossed."""

    side: Side
    term: str  # error that was too large, e.g. ``object_pos``
    value: float  # this hand's own, m or rad
    limit: float  # m or rad
    frame: int  # first scored row at which the error is beyond the limit, or -1


@dataclass(frozen=True)
class Verdict:
    """Result of one criterion on one rollout.

    The reason is empty when passed; ``limit``, ``incomplete``, ``numerics``,
    ``terminated`` when failed; ``static_reference``, ``no_object``, ``hand_absent``,
    ``no_scored_frames``, ``missing:<key>`` when not measured.
    """

    name: str  # criterion with its variant, e.g. ``sr_mt_obj_x2_left``
    state: State
    reason: str = ""
    values: Mapping[str, float] = field(default_factory=dict)  # of each term, m or rad
    limits: Mapping[str, float] = field(default_factory=dict)  # of each term, m or rad
    blame: tuple[Blame, ...] = ()  # every limit crossed, hands [left, right]
    grace: int = 0  # first steps that were not scored
    num_scored: int = 0  # frames that were
    fps: float = 0.0  # control rate, Hz

    @property
    def is_passed(self) -> bool:
        """True only for a measured pass."""
        return self.state == "passed"

    @property
    def blamed_sides(self) -> tuple[Side, ...]:
        """Hands that crossed a limit, in the order left, right."""
        return tuple(side for side in SIDES if any(b.side == side for b in self.blame))

    @property
    def failing_frame(self) -> int:
        """Earliest row beyond a limit, -1 if there is none."""
        return min((b.frame for b in self.blame if b.frame >= 0), default=-1)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


@cache
def limits_of(criterion: str, grace: int) -> Mapping[str, Any]:
    """Grace and limits of a criterion, as this version has them."""
    name = resolve_criterion(criterion)
    for known in make_criteria(grace=grace):
        if name in (known.name + s for s in ("", "_left", "_right")):
            limits = {term.quantity: term.limit for term in known.terms}
            return MappingProxyType({"grace": known.grace, **limits})
    raise AssertionError(name)


CriterionName = Literal[
    "sr_mt_obj",
    "sr_mt",
    "sr_mt_obj_x0.5",
    "sr_mt_obj_x2",
    "sr_mt_x0.5",
    "sr_mt_x2",
    "sr_loose",
    "sr_mt_obj_frame",
    "sr_mt_frame",
    "sr_mt_obj_p95",
    "sr_mt_obj_moved",
    "sr_spider_centred",
    "sr_spider_raw",
    "sr_spider_worst",
]
CRITERIA: tuple[str, ...] = get_args(CriterionName)
