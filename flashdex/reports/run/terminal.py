"""Plain-text tables for the terminal, at most 100 columns wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.metrics.criteria_table import Verdict
from flashdex.recipe import task_of_run
from flashdex.reports.run.facts import (
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
from flashdex.reports.run.report import write_report
from flashdex.reports.text import MAX_WIDTH, align, duration, plain, short, shorten
from flashdex.rollouts.findings import Finding

NAME_WIDTH = 18
BASELINES = {"do_nothing": "idle", "kinematic_playback": "playback"}
RATIOS = ("lift", "path")
STATES = {"passed": "yes", "failed": "no", "not_measured": "n.m."}


def run_table(run_dir: str | Path) -> str:
    """The facts of ``report.html`` for a terminal."""
    run = load_run(run_dir)
    rows = motion_facts(run)
    names = list(run.baselines)[: len(BASELINES)]
    found = [_cells(row, names) for row in rows]
    lines = ["no motion has been attempted yet"]
    if found:
        lines = align([list(found[0]), *(list(cells.values()) for cells in found)])
    out = [*_headline(run, rows), "", *lines, "", *_failures(rows)]
    out += [*_peaks(rows), *_legend(run)]
    return "\n".join(line[:MAX_WIDTH].rstrip() for line in out)


def _headline(run: RunData, rows: list[MotionFacts]) -> list[str]:
    counts, recipe = count(rows), run.recipe
    before = f"{len(run.before)} more converted by the run that it goes on from"
    shown = f"  ablation {run.ablation}" if run.ablation else ""
    return [
        f"{recipe.get('name', run.path.name)}{shown}  hand {recipe.get('hand', '?')}  "
        f"engine {recipe.get('physics', {}).get('engine', '?')}  {_progress(run)}",
        *filter(None, [world_of(recipe)]),
        f"{counts['converted']} of {num_motions(run, rows)} converted by "
        f"{run.criterion}, {counts['certified']} certified ({counts['robust']} robust, "
        f"{counts['strict']} strict), and {counts['trivial']} trivial, "
        f"{counts['attempts']:,} attempts",
        *([before] if run.before else []),
    ]


def _peaks(rows: list[MotionFacts]) -> list[str]:
    found = peaks(rows)
    words = {"penetration_mm": "deepest contact, mm", "force_n": "largest force, N"}
    parts = [f"{words[k]}: {a:.1f} median, {b:.1f} max" for k, (a, b) in found.items()]
    return [f"replays: {'; '.join(parts)}"] if parts else []


def _progress(run: RunData) -> str:
    steps, spent = f"{run.env_steps:,} env steps", duration(run.wall_s)
    return f"seed {run.recipe.get('seed', '?')}  {steps} in {spent}"


def _cells(row: MotionFacts, baselines: list[str]) -> dict[str, str]:
    first, (share, depth, force) = row.first, row.proof
    is_strict, worst = row.strict
    scores = {BASELINES.get(b, b)[:8]: row.baselines.get(b) for b in baselines}
    return {
        "motion": shorten(row.name + (" *" if row.trivial else ""), NAME_WIDTH),
        "hand": "+".join(side[0].upper() for side in row.hands) or "-",
        "tries": str(len(row.lines)),
        "steps": short(first["env_steps"]) if first else "-",
        "mm": _error(row.errors, "object_pos"),
        "deg": _error(row.errors, "object_rot"),
        "lift": plain(row.ratios[0], 2),
        "worst": plain(in_unit("object_pos", worst), 0),
        "half": {True: "yes", False: "no", None: "-"}[is_strict],
        "proof": row.verdict or "-",
        "pert": "-" if share is None else f"{share:.0%}",
        "pen": plain(depth),
        "N": plain(force, 0),
        **{name: _baseline(score) for name, score in scores.items()},
    }


def _error(errors: Mapping[str, float], quantity: str, *, digits: int = 1) -> str:
    value = errors.get(quantity, errors.get(f"{quantity}_centred"))
    return plain(in_unit(quantity, value), digits)


def _baseline(score: Mapping[str, Any] | None) -> str:
    errors = (score or {}).get("errors", {})
    return "/".join(_error(errors, q, digits=0) for q in ("object_pos", "object_rot"))


def _failures(rows: list[MotionFacts]) -> list[str]:
    failed = [row for row in rows if not row.is_converted]
    if not failed:
        return []
    width = max(min(len(row.name), NAME_WIDTH) for row in failed)
    lines = [f"  {shorten(r.name, width):<{width}}  {r.failures}" for r in failed]
    return ["not converted:", *lines, ""]


def _legend(run: RunData) -> list[str]:
    limits = [
        f"{SHOWN[term.quantity][0]} {in_unit(term.quantity, term.limit):g} "
        f"{SHOWN[term.quantity][1]}"
        for term in criterion_terms(run.criterion)
    ]
    lines = [
        f"limits of {run.criterion}: {', '.join(limits) or 'none'}",
        "pert: share of perturbed replays that pass; pen: deepest contact, mm; "
        "N: largest force",
        "lift: rise of the object over that of the recording; worst: largest error of "
        "a frame, mm",
        f"half, strict: {STRICT}, half of the limits, by the replay",
    ]
    if run.baselines:
        lines.append(
            "idle, playback: baselines without learning, mm/deg; *: one passes, or the "
            "object hardly moves"
        )
    return lines


def evaluation_table(
    rows: Sequence[Mapping[str, Any]], totals: Mapping[str, Any]
) -> str:
    """Scores of ``flashdex evaluate`` for a terminal.

    Rows, one a motion, hold name, state of each criterion, mean object errors in mm and
    rad, and ratios of movement; the totals hold counts of each criterion, and the means
    of these errors.
    """
    names = [key for key, value in totals.items() if isinstance(value, Mapping)]
    cells = [["motion", *names, "mm", "deg", *RATIOS]]
    for row in rows:
        errors = plain(row["mope"]), plain(in_unit("object_rot", row["more"]))
        states = [STATES.get(row[name], str(row[name])) for name in names]
        ratios = [plain(row[f"{name}_ratio"], 2) for name in RATIOS]
        cells.append([shorten(row["motion"], NAME_WIDTH), *states, *errors, *ratios])
    counts = [_rate(totals[name]) for name in names]
    means = plain(totals["mope_all"]), plain(in_unit("object_rot", totals["more_all"]))
    cells.append([f"all {len(rows)}", *counts, *means, "", ""])
    head = f"policy of {totals.get('env_steps', 0):,} env steps"
    notes = [*_means(totals), "n.m.: not measured on this motion"]
    return "\n".join([head, "", *align(cells), "", *notes])


def _rate(states: Mapping[str, int]) -> str:
    return f"{states['passed']}/{states['passed'] + states['failed']}"


def _means(totals: Mapping[str, Any]) -> list[str]:
    which = (("", "motions that pass sr_spider_centred"), ("_all", "all motions"))
    return [
        f"mean object error over {text} ({totals.get(f'mope{end}_motions', 0)}): "
        f"{plain(totals.get(f'mope{end}'))} mm, "
        f"{plain(in_unit('object_rot', totals.get(f'more{end}')))} deg"
        for end, text in which
    ]


def score_table(name: str, verdicts: Mapping[str, Verdict]) -> str:
    """Every criterion of a stored rollout, with the numbers that were compared."""
    cells = [["criterion", "state", "values against limits"]]
    for verdict in verdicts.values():
        if verdict.name.startswith("completed") and not verdict.is_passed:
            continue  # no file says how the episode ended
        parts = [
            f"{SHOWN[q][0]} {plain(in_unit(q, value))}/"
            f"{in_unit(q, verdict.limits[q]):g} {SHOWN[q][1]}"
            for q, value in verdict.values.items()
        ]
        shown = ", ".join(parts) or verdict.reason
        cells.append([verdict.name, verdict.state.replace("_", " "), shown])
    return "\n".join([name, *align(cells, left=(0, 1, 2))])


def replay_line(motion: str, stored: str | None, found: str, *, holds: bool) -> str:
    """One replayed rollout: its verdict in the run's files, and of the replay."""
    word = "holds" if holds else "DOES NOT HOLD"
    name = shorten(printable(motion), 40)
    stored = printable(stored or "none")
    return f"{name:<40}  stored {stored:<12}  found {found:<12}  {word}"


def finding_lines(findings: Sequence[Finding], why: str = "") -> list[str]:
    """Differences first, then what was not checked; alike ones of many files once.

    ``why``: why there is no library to check against, or empty.
    """
    lines = [f"DIFFERS  {printable(f)}" for f in findings if f.is_fault]
    unchecked: dict[str, int] = {}
    for finding in findings:
        if not finding.is_fault:
            text = f"{finding.what}: {finding.text}"
            unchecked[text] = unchecked.get(text, 0) + 1
    if why and unchecked:
        lines.append(f"not checked against a library: {printable(why)}")
    return lines + [
        f"not checked  {printable(text)}" + (f" ({count} times)" if count > 1 else "")
        for text, count in unchecked.items()
    ]


def verification_lines(
    path: Path, files: Sequence[str], findings: Sequence[Finding], why: str = ""
) -> list[str]:
    """What was read and is whole, what differs, what was not checked; a sum last."""
    faults = sum(finding.is_fault for finding in findings)
    lines = [f"ok       {printable(name)}" for name in files]
    end = f"{faults} differ: it is not what flashdex wrote" if faults else "holds"
    return [*lines, *finding_lines(findings, why), f"{printable(path)}: {end}"]


def printable(value: object) -> str:
    """One line of text that a terminal shows as it is."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(value))


ROWS = 12  # newest evaluations shown


def gym_run_table(run_dir: str | Path) -> str:
    """Return of the deterministic policy over env steps, newest last."""
    run = load_run(run_dir)
    env_id = run.recipe.get("gym", {}).get("env_id", "?")
    head = f"{run.recipe.get('name', run.path.name)}  {env_id}  {_progress(run)}"
    found = [record for record in run.metrics if "eval/return" in record]
    if not found:
        return f"{head}\nnot evaluated yet; records: {run.path / 'metrics.jsonl'}"
    cells = [["env steps", "return", "std", "length"]]
    for r in found[-ROWS:]:
        figures = [f"{r[f'eval/{name}']:.1f}" for name in ("return", "return_std")]
        cells.append([f"{int(r['env_steps']):,}", *figures, f"{r['eval/length']:.0f}"])
    lines = align(cells, left=())
    return "\n".join([head, "", *lines, "", f"records: {run.path / 'metrics.jsonl'}"])


def run_summary(run_dir: Path) -> str:
    """Table of a run; of one with motions, the report is written as well."""
    if task_of_run(run_dir) == "gym":
        return gym_run_table(run_dir)
    table = run_table(run_dir)
    try:
        return f"{table}\n\nreport: {write_report(run_dir)}"
    except RunError as error:  # the run is done, and its table is there
        return f"{table}\n\nno report: {error}"
