"""One criterion's answer: passed, failed or not measured, with numbers and blame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from flashdex.keys import SIDES, Side

State = Literal["passed", "failed", "not_measured"]
CertificateVerdict = Literal["certified", "robust", "failed", "not_measured"]


@dataclass(frozen=True)
class Blame:
    """One limit that one hand crossed.

    Args:
        side: the hand, or the hand of that object.
        term: signal that was too large, e.g. ``object_pos``.
        value: this hand's own value, m or rad.
        limit: m or rad.
        frame: first scored row at which the signal itself is beyond the limit, or -1.
    """

    side: Side
    term: str
    value: float
    limit: float
    frame: int


@dataclass(frozen=True)
class Verdict:
    """Result of one criterion on one rollout.

    Args:
        name: criterion with its variant, e.g. ``sr_mt_obj_x2_left``.
        state: passed, failed or not_measured.
        reason: empty when passed; ``limit``, ``incomplete``, ``numerics``,
            ``terminated`` when failed; ``static_reference``, ``no_object``,
            ``hand_absent``, ``no_scored_frames``, ``missing:<key>`` when not measured.
        values: term -> value that was compared, m or rad.
        limits: term -> limit, m or rad.
        blame: every limit crossed, hands [left, right].
        grace: first steps that were not scored.
        num_scored: frames that were.
        fps: control rate, Hz.
    """

    name: str
    state: State
    reason: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    blame: tuple[Blame, ...] = ()
    grace: int = 0
    num_scored: int = 0
    fps: float = 0.0

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
