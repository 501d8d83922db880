"""The per-motion table of the report."""

from __future__ import annotations

from flashdex.reports.page import NOTHING, Html, joined, number, safe, table, tag
from flashdex.reports.run.facts import (
    PROVEN,
    SHOWN,
    MotionFacts,
    RunData,
    criterion_terms,
    in_unit,
)

BASELINE_WORDS = {"do_nothing": "do nothing", "kinematic_playback": "playback"}


def motion_table(run: RunData, rows: list[MotionFacts], *, total: int) -> Html:
    """Every motion: errors against limits, proof, and what needs no learning.

    Args:
        run: the files.
        rows: motions.
        total: motions of the collection.
    """
    if not rows:
        return tag("p", "No motion has been attempted yet.", class_="soft")
    quantities = shown_quantities(run.criterion)
    limits = {t.quantity: t.limit for t in criterion_terms(run.criterion)}
    heads = [_error_heading(q, limits.get(q)) for q in quantities]
    headings = [
        "motion",
        "hands",
        "attempts",
        "env steps",
        "minutes",
        *heads,
        "certificate",
        "robust share",
        "penetration mm",
        "force N",
        *(f"{BASELINE_WORDS.get(b, b)}, mm / deg" for b in run.baselines),
        "failures",
    ]
    cells = [_cells(run, row, quantities, limits) for row in rows]
    rest = total - len(rows)
    note = [tag("p", f"{rest} more motions were not attempted yet.")] if rest else []
    return joined([tag("div", table(headings, cells), class_="wide"), *note])


def shown_quantities(criterion: str) -> list[str]:
    """Errors worth a column: the object's always, and all that the criterion limits.

    Args:
        criterion: its name.
    """
    named = [term.quantity for term in criterion_terms(criterion)]
    base = [] if "object_pos_centred" in named else ["object_pos"]
    return [q for q in dict.fromkeys([*base, *named, "object_rot"]) if q in SHOWN]


def table_notes(run: RunData) -> Html:
    """What the columns mean.

    Args:
        run: the files.
    """
    text = (
        "Env steps and minutes: when the motion was first converted. Errors of a "
        "motion that is not converted are those of its best complete attempt; failures "
        "name what ended or failed most attempts. Red is beyond the limit of "
        f"{run.criterion}. Certificate: the stored controls replayed open loop in "
        "MuJoCo C; robust: at least three quarters of the perturbed replays pass too. "
        "Penetration and force are the peaks of that replay."
    )
    trivial = (
        " A motion that a baseline without learning passes is marked trivial."
        if run.baselines
        else " Baselines were not run."
    )
    return tag("p", text + trivial, class_="soft small")


def _error_heading(quantity: str, limit: float | None) -> str:
    name, unit, _ = SHOWN[quantity]
    shown = in_unit(quantity, limit)
    return f"{name} {unit}" + ("" if shown is None else f" (≤\u00a0{shown:g})")


def _cells(
    run: RunData, row: MotionFacts, quantities: list[str], limits: dict[str, float]
) -> list[Html | str]:
    first = row.first or {}
    return [
        _name(row),
        _hands(row),
        f"{row.attempts:,}",
        f"{first['env_steps']:,}" if first else NOTHING,
        number(first["wall_s"] / 60) if first else NOTHING,
        *(_error(row.errors.get(q), q, limits.get(q)) for q in quantities),
        _verdict(row),
        NOTHING if row.robust_share is None else f"{row.robust_share:.0%}",
        number(row.penetration_mm),
        number(row.force),
        *(_baseline(row, name, run.criterion) for name in run.baselines),
        row.failures or NOTHING,
    ]


def _name(row: MotionFacts) -> Html:
    marks = [tag("span", "trivial", class_="tag", title=", ".join(row.trivial))]
    # long names may be broken after an underscore, and only there
    name = Html(safe(row.name).replace("_", "_<wbr>"))
    return joined([tag("span", name), *(marks if row.trivial else [])], " ")


def _hands(row: MotionFacts) -> str:
    return "both" if len(row.hands) == 2 else "".join(row.hands) or NOTHING


def _error(value: float | None, quantity: str, limit: float | None) -> Html:
    is_beyond = value is not None and limit is not None and value > limit
    shown = number(in_unit(quantity, value))
    return tag("span", shown, class_="bad" if is_beyond else "")


def _verdict(row: MotionFacts) -> Html | str:
    if not row.is_converted:
        return NOTHING
    words = row.verdict.replace("_", " ")
    reason = row.certificate.get("reason", "")
    if reason:
        words += f" ({reason})"
    return tag("span", words, class_="good" if row.verdict in PROVEN else "bad")


def _baseline(row: MotionFacts, name: str, criterion: str) -> Html | str:
    score = row.baselines.get(name)
    if score is None:
        return NOTHING
    errors = score.get("errors", {})
    numbers = [
        number(in_unit(q, errors.get(q)), 0) for q in ("object_pos", "object_rot")
    ]
    if "object_pos_centred" in errors:
        numbers[0] = number(in_unit("object_pos", errors["object_pos_centred"]), 0)
    passes = criterion in score.get("passed", [])
    return tag("span", " / ".join(numbers), " passes" if passes else "")
