"""Score a rollout by every named criterion (the table is in ``criteria_table``).

Three states: passed, failed, not measured. What cannot be measured on a file is decided
before what failed, so that all methods that share a motion share one denominator.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from flashdex.keys import SIDES, Side
from flashdex.metrics.continuous import (
    follow_ratio,
    lift_ratio,
    off_by,
    path_ratio,
)
from flashdex.metrics.criteria_table import (
    Blame,
    Criterion,
    Limits,
    State,
    Term,
    Verdict,
    criterion_names,
    make_criteria,
    resolve_criterion,
)
from flashdex.metrics.errors import (
    TrackingErrors,
    centred_position_error,
    reference_drift,
)

__all__ = ["Limits", "criterion_names", "make_criteria", "resolve_criterion", "score"]

MIN_FOLLOW = 0.5  # share of the reference's way below which an object stays behind
STATIC_DRIFT = 1e-3  # m; a reference that moves less on average counts as static


def movement(errors: TrackingErrors, slot: int) -> dict[str, float | None]:
    """Lift and path ratio of one object, None where the reference asks for none."""
    track = errors.object_track(slot)
    if track is None or len(track[0]) == 0:
        return {"lift": None, "path": None}
    return {"lift": lift_ratio(*track), "path": path_ratio(*track)}


def worst_movement(errors: TrackingErrors) -> dict[str, float | None]:
    """Lift and path ratio of the hands' object whose ratio is farthest from 1."""
    slots = dict.fromkeys(errors.slots) if errors.is_finite else ()
    found = [movement(errors, slot) for slot in slots]
    return {
        key: max(
            (m[key] for m in found if m[key] is not None), key=off_by, default=None
        )
        for key in ("lift", "path")
    }


def stays_behind(errors: TrackingErrors) -> bool:
    """A hand's object moves too little, or not the way that the reference goes."""
    if not errors.is_finite:
        return False
    for slot in dict.fromkeys(errors.slots):
        track = errors.object_track(slot)
        if track is None or len(track[0]) == 0:
            continue
        follows = follow_ratio(*track)
        if moves_too_little(movement(errors, slot)) or (
            follows is not None and follows < MIN_FOLLOW
        ):
            return True
    return False


def moves_too_little(ratios: Mapping[str, float | None]) -> bool:
    """An object stays behind what the reference asks for, by lift or by path."""
    limits = Limits()
    allowed = {"lift": limits.lift, "path": limits.path}
    return any(
        (ratio := ratios.get(key)) is not None and ratio < 1 / (1 + limit)
        for key, limit in allowed.items()
    )


def _series(errors: TrackingErrors, term: Term, side: int, grace: int) -> Tensor | str:
    """One hand's error over the scored window, (T - grace,), or what is missing.

    Ratios of a whole movement are one value.
    """
    if term.quantity in ("lift", "path"):
        if errors.object_pos_offset is None:
            return f"missing:{errors.missing.get('object_pos', 'object_pos')}"
        ratio = movement(errors, errors.hand_object[side])[term.quantity]
        return torch.tensor([off_by(ratio)], dtype=torch.float64)
    source = {
        "object_pos": ("object_pos", errors.object_pos_error),
        "object_pos_centred": ("object_pos", errors.object_pos_offset),
        "object_rot": ("object_quat", errors.object_rot_error),
        "fingertip": ("fingertips", errors.fingertip_error),
        "joint": ("joints", errors.joint_error),
        "wrist_pos": ("wrist_pos", errors.wrist_pos_error),
    }
    key, value = source[term.quantity]
    if value is None:
        return f"missing:{errors.missing.get(key, key)}"
    is_object = term.is_of_object
    window = value[grace:, errors.hand_object[side] if is_object else side]
    if term.quantity == "object_pos_centred":
        return centred_position_error(window)
    return window.mean(-1) if term.quantity == "fingertip" else window


def _reduce_time(series: Tensor, how: str) -> float:
    if how == "max":
        return float(series.max())
    if how == "p95":
        return float(torch.quantile(series, 0.95))
    return float(series.mean())


def _is_beyond(value: Any, term: Term) -> Any:
    """A number or each of a series against the limit."""
    return value >= term.limit if term.strict else value > term.limit


def _blame(term: Term, side: Side, series: Tensor, grace: int) -> Blame:
    rows = _is_beyond(series, term).nonzero()
    # a ratio of the whole movement has no frame
    has_frames = term.quantity not in ("lift", "path")
    frame = int(rows[0]) + grace if len(rows) and has_frames else -1
    value = _reduce_time(series, term.time)
    return Blame(side, term.quantity, value, term.limit, frame)


def _object_sides(
    errors: TrackingErrors, criterion: Criterion, sides: list[int]
) -> list[int]:
    """Hands whose object counts; some rules drop static references."""
    chosen = [h for h in sides if errors.slot(h) >= 0]
    if criterion.drop_static and errors.ref_object_pos is not None:
        drift = reference_drift(errors.ref_object_pos)
        chosen = [h for h in chosen if float(drift[errors.slot(h)]) >= STATIC_DRIFT]
    return chosen


def _unmeasurable(
    errors: TrackingErrors,
    criterion: Criterion,
    sides: list[int],
    completed: bool | None,
) -> str:
    """Why the criterion has no meaning on this file, or an empty string."""
    if not [h for h in sides if errors.hand_active[h]]:
        return "hand_absent"
    if criterion.family == "completed":
        return "missing:completed" if completed is None else ""
    if not [h for h in sides if errors.slot(h) >= 0]:
        return "no_object"
    for term in criterion.terms:
        series = _series(errors, term, 0, 0)
        if isinstance(series, str):
            return series
    if not _object_sides(errors, criterion, sides):
        return "static_reference"
    return ""


def _measure(
    errors: TrackingErrors, criterion: Criterion, sides: list[int]
) -> tuple[dict[str, float], list[Blame]]:
    """Values that are compared with the limits, and who is beyond them."""
    values: dict[str, float] = {}
    blames: list[Blame] = []
    hands = [h for h in sides if errors.hand_active[h]]
    objects = _object_sides(errors, criterion, sides)
    for term in criterion.terms:
        used = objects if term.is_of_object else hands
        series = {
            h: cast(Tensor, _series(errors, term, h, criterion.grace)) for h in used
        }
        own = {h: _reduce_time(s, term.time) for h, s in series.items()}
        mean = sum(own.values()) / len(own)
        value = max(own.values()) if term.hands == "worst" else mean
        values[term.quantity] = value
        if _is_beyond(value, term):
            guilty = [h for h in used if _is_beyond(own[h], term)] or used
            grace = criterion.grace
            blames += [_blame(term, SIDES[h], series[h], grace) for h in guilty]
    return values, sorted(blames, key=lambda b: b.side)


def _score_one(
    errors: TrackingErrors,
    criterion: Criterion,
    name: str,
    sides: list[int],
    completed: bool | None,
    partial: bool,
) -> Verdict:
    def short(state: State, reason: str = "") -> Verdict:
        return Verdict(name, state, reason, fps=errors.fps)

    reason = _unmeasurable(errors, criterion, sides, completed)
    if reason:
        return short("not_measured", reason)
    if not errors.is_finite:
        return short("failed", "numerics")
    if criterion.family == "completed":
        return short("passed") if completed else short("failed", "terminated")
    is_short = errors.num_frames < errors.num_ref_frames - 1
    if is_short and not (partial and criterion.family == "spider"):
        return short("failed", "incomplete")
    num_scored = errors.num_frames - criterion.grace
    if num_scored <= 0:
        return short("not_measured", "no_scored_frames")
    values, blames = _measure(errors, criterion, sides)
    return Verdict(
        name,
        "failed" if blames else "passed",
        "limit" if blames else "",
        values,
        {t.quantity: t.limit for t in criterion.terms},
        tuple(blames),
        criterion.grace,
        num_scored,
        errors.fps,
    )


def score(
    errors: TrackingErrors,
    *,
    grace: int = 15,
    limits: Limits | None = None,
    completed: bool | None = None,
    partial: bool = False,
) -> dict[str, Verdict]:
    """Score one rollout by every criterion, for both hands together and for each hand.

    Args:
        errors: errors and masks of the rollout.
        grace: first steps the ManipTrans family does not score.
        limits: other limits than the published ones.
        completed: the rollout reached the clip end under the training terminations;
            None when they were not evaluated.
        partial: score the SPIDER family on the available part of a short rollout.

    Returns:
        name -> verdict, in the order of :func:`criterion_names`.
    """
    variants = {"": [0, 1], "_left": [0], "_right": [1]}
    return {
        c.name + suffix: _score_one(
            errors, c, c.name + suffix, sides, completed, partial
        )
        for c in make_criteria(limits=limits, grace=grace)
        for suffix, sides in variants.items()
    }
