"""``report.html`` of a run: one page without any outside address."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.reports.page import write_page
from flashdex.reports.render.films import Film, draw_films
from flashdex.reports.run.curves import conversion_charts, learning_charts
from flashdex.reports.run.facts import (
    PROVEN,
    SHOWN,
    Line,
    MotionFacts,
    RunData,
    count,
    criterion_terms,
    in_unit,
    load_run,
    motion_facts,
    num_motions,
)
from flashdex.reports.text import NOTHING, duration, number

REPORT = "report.html"
MAX_FILMS = 60  # inside the page; the files of all others lie in films/
BASELINE_WORDS = {"do_nothing": "do nothing", "kinematic_playback": "playback"}
Cell = tuple[str, str]  # text, and "good" or "bad" where it is marked


def write_report(run_dir: str | Path) -> Path:
    """Draw the films that are missing and write ``report.html``.

    Args:
        run_dir: run directory, finished or not.

    Returns:
        The page.

    Raises:
        RunError: this is no run directory, or it cannot be written.

    Example:
        >>> write_report("runs/quickstart-none-s0")  # doctest: +SKIP
        PosixPath('runs/quickstart-none-s0/report.html')
    """
    run = load_run(run_dir)
    rows = motion_facts(run)
    total = num_motions(run, rows)
    stored = _stored_rollouts(run, rows)
    wanted = run.recipe.get("train", {}).get("render_conversions", True)
    fault = draw_films(list(stored.values())) if wanted else ""
    films = [
        (row, film)
        for row in rows
        if row.name in stored and (film := Film.of(stored[row.name])).video.is_file()
    ]
    return write_page(
        run.path / REPORT,
        "run.html",
        error=RunError,
        name=str(run.recipe.get("name", run.path.name)),
        header=_header(run),
        numbers=_numbers(rows, total),
        promises=_promises(run),
        conversions=conversion_charts(run, rows, total=total),
        headings=_headings(run),
        rows=[(row, _cells(run, row)) for row in rows],
        total=total,
        criterion=run.criterion,
        baselines=run.baselines,
        any_converted=any(row.is_converted for row in rows),
        fault=fault,
        films=films,
        max_films=MAX_FILMS,
        learning=learning_charts(run),
    )


def _header(run: RunData) -> list[tuple[str, Any]]:
    recipe, versions = run.recipe, dict(run.versions)
    hardware = versions.pop("hardware", None)
    if isinstance(hardware, dict):
        hardware = ", ".join(f"{k} {v}" for k, v in hardware.items())
    steps = f"{run.env_steps:,}"
    if recipe.get("total_env_steps"):
        steps += f" of {recipe['total_env_steps']:,}"
    return [
        ("recipe", recipe.get("name")),
        ("ablation", run.ablation),
        ("hand", recipe.get("hand")),
        ("engine", recipe.get("physics", {}).get("engine")),
        ("seed", recipe.get("seed")),
        ("criterion", run.criterion),
        ("env steps", steps),
        ("wall time", duration(run.wall_s)),
        ("hardware", hardware or "not recorded"),
        ("versions", ", ".join(f"{k} {v}" for k, v in versions.items())),
    ]


def _numbers(rows: list[MotionFacts], total: int) -> list[tuple[str, str]]:
    counts = count(rows)
    converted = counts["converted"]
    proven = ("certified", "robust", "trivial")
    return [
        ("converted", f"{converted}/{total}"),
        *((name, f"{counts[name]}/{converted}") for name in proven),
        ("attempts", f"{counts['attempts']:,}"),
    ]


def _promises(run: RunData) -> list[str]:
    """What the recipe promised, beside the value at that many env steps."""
    lines = []
    for promise in run.recipe.get("expect") or []:
        at, key = promise["at_env_steps"], promise["metric"]
        records = [r for r in run.metrics if key in r]
        reached = [r for r in records if r["env_steps"] >= at]
        # A run that has converted everything has nothing more to reach.
        if records and records[-1].get("convert/rate") == 1.0:
            reached = reached or records[-1:]
        bounds = " ".join(
            f"{k} {promise[k]:g}" for k in ("min", "max") if promise.get(k) is not None
        )
        found = number(reached[0][key], 3) if reached else "not reached yet"
        lines.append(f"Promised: {key} {bounds} at {at:,} env steps. Found: {found}.")
    return lines


def _stored_rollouts(run: RunData, rows: list[MotionFacts]) -> dict[str, Path]:
    """Rollout file of each conversion; a path that leaves the run is not followed."""
    found = {}
    for row in rows:
        named = (row.first or {}).get("rollout")
        if named:
            path = run.path / "rollouts" / Path(named).name
            if path.is_file():
                found[row.name] = path
    return found


def _shown_limits(criterion: str) -> dict[str, float | None]:
    """Errors worth a column, with limits: the object's, and what the criterion has."""
    limits = {term.quantity: term.limit for term in criterion_terms(criterion)}
    base = [] if "object_pos_centred" in limits else ["object_pos"]
    shown = dict.fromkeys([*base, *limits, "object_rot"])
    return {q: limits.get(q) for q in shown if q in SHOWN}


def _headings(run: RunData) -> list[str]:
    errors = []
    for quantity, limit in _shown_limits(run.criterion).items():
        name, unit, _ = SHOWN[quantity]
        shown = in_unit(quantity, limit)
        errors.append(
            f"{name} {unit}" + ("" if shown is None else f" (≤\u00a0{shown:g})")
        )
    return [
        *("motion", "hands", "attempts", "env steps", "minutes"),
        *errors,
        *("certificate", "robust share", "penetration mm", "force N"),
        *(f"{BASELINE_WORDS.get(b, b)}, mm / deg" for b in run.baselines),
        "failures",
    ]


def _cells(run: RunData, row: MotionFacts) -> list[Cell]:
    """A row of the table of motions, without the name."""
    first, limits = row.first or {}, _shown_limits(run.criterion)
    share = row.robust_share
    texts = [
        "both" if len(row.hands) == 2 else "".join(row.hands) or NOTHING,
        f"{len(row.lines):,}",
        f"{first['env_steps']:,}" if first else NOTHING,
        number(first["wall_s"] / 60) if first else NOTHING,
    ]
    proof = [
        NOTHING if share is None else f"{share:.0%}",
        number(row.penetration_mm),
        number(row.force),
        *(_baseline(row.baselines.get(b), run.criterion) for b in run.baselines),
        row.failures or NOTHING,
    ]
    return [
        *((text, "") for text in texts),
        *(_error(row.errors.get(q), q, limit) for q, limit in limits.items()),
        _verdict(row),
        *((text, "") for text in proof),
    ]


def _error(value: float | None, quantity: str, limit: float | None) -> Cell:
    is_beyond = value is not None and limit is not None and value > limit
    return number(in_unit(quantity, value)), "bad" if is_beyond else ""


def _verdict(row: MotionFacts) -> Cell:
    if not row.is_converted:
        return NOTHING, ""
    reason = row.certificate.get("reason", "")
    words = row.verdict.replace("_", " ") + (f" ({reason})" if reason else "")
    return words, "good" if row.verdict in PROVEN else "bad"


def _baseline(score: Line | None, criterion: str) -> str:
    if score is None:
        return NOTHING
    errors = score.get("errors", {})
    place = errors.get("object_pos_centred", errors.get("object_pos"))
    passes = " passes" if criterion in score.get("passed", []) else ""
    shown = {"object_pos": place, "object_rot": errors.get("object_rot")}
    return " / ".join(number(in_unit(q, e), 0) for q, e in shown.items()) + passes
