"""``report.html`` of a run: one page without any outside address."""

from __future__ import annotations

from pathlib import Path

from flashdex.errors import RunError
from flashdex.reports.page import (
    Html,
    duration,
    facts,
    inline,
    joined,
    number,
    page,
    tag,
)
from flashdex.reports.render.films import Film, draw_films
from flashdex.reports.run.curves import conversion_charts, learning_charts
from flashdex.reports.run.facts import (
    MotionFacts,
    RunData,
    count,
    load_run,
    motion_facts,
    num_motions,
)
from flashdex.reports.run.motion_table import motion_table, table_notes
from flashdex.system.files import write_atomic

REPORT = "report.html"
GHOST_NOTE = (
    "Blue, translucent: where the recording has the object; it fades where both agree."
)
MAX_FILMS = 60  # inside the page; the files of all others lie in films/


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
    stored = _stored_rollouts(run, rows)
    wanted = run.recipe.get("train", {}).get("render_conversions", True)
    fault = draw_films(list(stored.values())) if wanted else ""
    name = str(run.recipe.get("name", run.path.name))
    text = page(f"{name}: flashdex run", _sections(run, rows, stored, fault, name))
    path = run.path / REPORT
    try:
        write_atomic(path, text)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}).") from error
    return path


def _sections(
    run: RunData,
    rows: list[MotionFacts],
    stored: dict[str, Path],
    fault: str,
    name: str,
) -> list[Html]:
    total = num_motions(run, rows)
    conversions = conversion_charts(run, rows, total=total)
    parts = [
        tag("h1", name),
        _header(run),
        _numbers(rows, total),
        _promises(run),
        tag("h2", "Conversions"),
        tag("div", *conversions, class_="charts large"),
        tag("h2", "Motions"),
        motion_table(run, rows, total=total),
        table_notes(run),
    ]
    if any(row.is_converted for row in rows):
        parts += [tag("h2", "Films"), _films(rows, stored, fault)]
    for heading, charts in learning_charts(run):
        parts += [tag("h2", heading), tag("div", *charts, class_="charts")]
    return parts


def _header(run: RunData) -> Html:
    recipe, versions = run.recipe, dict(run.versions)
    hardware = versions.pop("hardware", None)
    if isinstance(hardware, dict):
        hardware = ", ".join(f"{k} {v}" for k, v in hardware.items())
    steps = f"{run.env_steps:,}"
    if recipe.get("total_env_steps"):
        steps += f" of {recipe['total_env_steps']:,}"
    ablation = recipe.get("ablation", "none")
    return facts(
        [
            ("recipe", recipe.get("name")),
            ("ablation", "" if ablation == "none" else ablation),
            ("hand", recipe.get("hand")),
            ("engine", recipe.get("physics", {}).get("engine")),
            ("seed", recipe.get("seed")),
            ("criterion", run.criterion),
            ("env steps", steps),
            ("wall time", duration(run.wall_s)),
            ("hardware", hardware or "not recorded"),
            ("versions", ", ".join(f"{k} {v}" for k, v in versions.items())),
        ]
    )


def _numbers(rows: list[MotionFacts], total: int) -> Html:
    counts = count(rows)
    cells = [
        ("converted", f"{counts['converted']}/{total}"),
        ("certified", f"{counts['certified']}/{counts['converted']}"),
        ("robust", f"{counts['robust']}/{counts['converted']}"),
        ("trivial", f"{counts['trivial']}/{counts['converted']}"),
        ("attempts", f"{counts['attempts']:,}"),
    ]
    boxes = [tag("div", tag("b", value), name) for name, value in cells]
    return tag("div", *boxes, class_="numbers")


def _promises(run: RunData) -> Html:
    """What the recipe promised, beside the value at that many env steps."""
    lines = []
    for promise in run.recipe.get("expect") or []:
        at, key = promise["at_env_steps"], promise["metric"]
        records = [r for r in run.metrics if key in r]
        reached = [r for r in records if r["env_steps"] >= at]
        # A run that has converted everything has nothing more to reach.
        if records and records[-1].get("convert/rate") == 1.0:
            reached = reached or records[-1:]
        bounds = [
            f"{k} {promise[k]:g}" for k in ("min", "max") if promise.get(k) is not None
        ]
        found = number(reached[0][key], 3) if reached else "not reached yet"
        text = (
            f"Promised: {key} {' '.join(bounds)} at {at:,} env steps. Found: {found}."
        )
        lines.append(tag("p", text))
    return joined(lines)


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


def _films(rows: list[MotionFacts], stored: dict[str, Path], fault: str) -> Html:
    figures = [
        _figure(row, Film.of(stored[row.name]))
        for row in rows
        if row.name in stored and Film.of(stored[row.name]).video.is_file()
    ]
    notes = [tag("p", f"{fault}.", class_="bad")] if fault else []
    note = GHOST_NOTE if figures else "No films of this run."
    notes.append(tag("p", note, class_="soft"))
    if len(figures) > MAX_FILMS:
        rest = len(figures) - MAX_FILMS
        notes.append(tag("p", f"{rest} more films lie in the folder films/."))
    grid = tag("div", *figures[:MAX_FILMS], class_="films")
    return joined([*notes, grid])


def _figure(row: MotionFacts, film: Film) -> Html:
    video = tag(
        "video",
        src=inline(film.video),
        poster=inline(film.poster),
        controls="controls",
        loop="loop",
        muted="muted",
        playsinline="playsinline",
        preload="none",
    )
    stills = Html(f'<img src="{inline(film.stills)}" alt="stills">')
    caption = tag("figcaption", f"{row.name}: {row.verdict}")
    return tag("figure", video, stills, caption)
