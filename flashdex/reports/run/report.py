"""``report.html`` of a run: one page without any outside address."""

from __future__ import annotations

import os
from pathlib import Path

from flashdex.errors import RunError
from flashdex.reports.page import write_page
from flashdex.reports.render.films import Film, draw_films
from flashdex.reports.run.curves import conversion_charts, learning_charts
from flashdex.reports.run.facts import (
    PROVEN,
    SHOWN,
    STRICT,
    MotionFacts,
    RunData,
    count,
    criterion_terms,
    in_unit,
    load_run,
    motion_facts,
    num_motions,
    peaks,
    world_of,
)
from flashdex.reports.text import NOTHING, number
from flashdex.system.files import own_file
from flashdex.system.run_files import REPORT, rollout_name

MAX_FILMS = 60  # inside the page; the files of all others lie in films/
BASELINE_WORDS = {"do_nothing": "do nothing", "kinematic_playback": "playback"}
Cell = tuple[str, str]  # text, and "good" or "bad" where it is marked


def write_report(run_dir: str | Path) -> Path:
    """Draw the films that are missing of a run, finished or not; write ``report.html``.

    Raises:
        RunError: this is no run directory, or it cannot be written.
    """
    run = load_run(run_dir)
    if not os.access(run.path, os.W_OK):  # said before films are drawn
        raise RunError(f"{run.path}: cannot be written, so there is no {REPORT}.")
    rows = motion_facts(run)
    total = num_motions(run, rows)
    stored = _stored_rollouts(run, rows)
    wanted = run.recipe.get("train", {}).get("render_conversions", True)
    fault = draw_films(list(stored.values())) if wanted else ""
    films = [
        (row, film)
        for row in rows
        if row.name in stored and (film := Film.of(stored[row.name])).is_whole
    ]
    return write_page(
        run.path / REPORT,
        "run.html",
        error=RunError,
        name=str(run.recipe.get("name", run.path.name)),
        run=run,
        hardware=_hardware(run),
        counts=count(rows),
        peaks=peaks(rows),
        world=world_of(run.recipe),
        promises=_promises(run),
        conversions=conversion_charts(run, rows, total=total),
        rows=[(row, _cells(run, row)) for row in rows],
        total=total,
        fault=fault,
        films=films,
        max_films=MAX_FILMS,
        learning=learning_charts(run),
    )


def _hardware(run: RunData) -> str:
    found = run.versions.get("hardware")
    if isinstance(found, dict):
        return ", ".join(f"{k} {v}" for k, v in found.items())
    return str(found or "not recorded")


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
    """Rollout file of each conversion, where its line names one: only its own."""
    found = {}
    for row in rows:
        named = (row.first or {}).get("rollout")
        if named:
            path = own_file(run.path, rollout_name(row.name))
            if path.is_file():
                found[row.name] = path
    return found


def _shown_limits(criterion: str) -> dict[str, float | None]:
    """Errors worth a column, with limits: the object's, and what the criterion has."""
    limits = {term.quantity: term.limit for term in criterion_terms(criterion)}
    base = [] if "object_pos_centred" in limits else ["object_pos"]
    shown = dict.fromkeys([*base, *limits, "object_rot"])
    return {q: limits.get(q) for q in shown if q in SHOWN}


def _cells(run: RunData, row: MotionFacts) -> dict[str, Cell]:
    """A row of the table of motions by heading, without the name."""
    first, (share, depth, force) = row.first, row.proof
    is_strict, worst = row.strict
    limits = _shown_limits(run.criterion)
    errors = dict(_error(row, q, limit) for q, limit in limits.items())
    baselines = {
        f"{BASELINE_WORDS.get(b, b)}, mm / deg": (_baseline(row, b), "")
        for b in run.baselines
    }
    return {
        "hands": ("both" if len(row.hands) == 2 else "".join(row.hands) or NOTHING, ""),
        "attempts": (f"{len(row.lines):,}", ""),
        "env steps": (f"{first['env_steps']:,}" if first else NOTHING, ""),
        "minutes": (number(first["wall_s"] / 60) if first else NOTHING, ""),
        **errors,
        "lift ratio": (number(row.ratios[0], 2), ""),
        "path ratio": (number(row.ratios[1], 2), ""),
        "worst frame mm": (number(in_unit("object_pos", worst)), ""),
        STRICT: ({True: "passes", False: "fails", None: NOTHING}[is_strict], ""),
        "certificate": _verdict(row),
        "robust share": (NOTHING if share is None else f"{share:.0%}", ""),
        "penetration mm": (number(depth), ""),
        "force N": (number(force), ""),
        **baselines,
        "failures": (row.failures or NOTHING, ""),
    }


def _error(row: MotionFacts, quantity: str, limit: float | None) -> tuple[str, Cell]:
    (name, unit, _), value = SHOWN[quantity], row.errors.get(quantity)
    bound = "" if limit is None else f" (≤\u00a0{in_unit(quantity, limit):g})"
    is_beyond = value is not None and limit is not None and value > limit
    cell = number(in_unit(quantity, value)), "bad" if is_beyond else ""
    return f"{name} {unit}{bound}", cell


def _verdict(row: MotionFacts) -> Cell:
    if not row.is_converted:
        return NOTHING, ""
    reason = row.certificate.get("reason", "")
    words = row.verdict.replace("_", " ") + (f" ({reason})" if reason else "")
    return words, "good" if row.verdict in PROVEN else "bad"


def _baseline(row: MotionFacts, name: str) -> str:
    if name not in row.baselines:
        return NOTHING
    errors = row.baselines[name].get("errors", {})
    place = errors.get("object_pos_centred", errors.get("object_pos"))
    shown = {"object_pos": place, "object_rot": errors.get("object_rot")}
    words = " / ".join(number(in_unit(q, e), 0) for q, e in shown.items())
    passes = row.run.criterion in row.baselines[name].get("passed", [])
    return words + (" passes" if passes else "")
