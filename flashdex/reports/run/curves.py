"""Charts of a run: conversions over env steps and time, and what was learnt."""

from __future__ import annotations

from markupsafe import Markup

from flashdex.reports.chart import Series, line_chart
from flashdex.reports.run.facts import Line, MotionFacts, RunData

SIDES = ("left", "right", "both")
STEPS = "env steps"
MINUTES_BELOW_S = 2 * 3600.0  # a shorter run is drawn over minutes
# heading -> groups of keys in metrics.jsonl
GROUPS = {
    "Reward terms per hand": ("reward",),
    "Object error while training": ("error",),
    "How episodes end, share": ("episode",),
    "Losses": ("loss",),
    "Speed and buffer": ("perf", "buffer"),
    "Assist": ("assist",),
}
LEFT_OUT = ("episode/ends",)  # a count among shares


def conversion_charts(
    run: RunData, facts: list[MotionFacts], *, total: int
) -> list[Markup]:
    """Cumulative conversions over env steps and time; the axis ends at the total."""
    unit, seconds = ("hours", 3600.0)
    if run.wall_s < MINUTES_BELOW_S:
        unit, seconds = ("minutes", 60.0)
    passed = [f for f in facts if f.first]
    groups = {"converted": [f for f in passed if not f.trivial]}
    if len(passed) > len(groups["converted"]):
        groups["and trivial"] = passed

    def chart(key: str, scale: float, end: float, label: str) -> Markup:
        return line_chart(
            [_steps(name, found, key, scale, end) for name, found in groups.items()],
            title="Converted motions",
            x_label=label,
            is_step=True,
            y_range=(0.0, float(max(total, 1))),
        )

    charts = [chart("env_steps", 1.0, run.env_steps, STEPS)]
    if "core_s" in next(iter(run.attempts), {}):  # of a search
        end = run.attempts[-1]["core_s"] / 60
        return [*charts, chart("core_s", 60.0, end, "core-minutes of search")]
    label = f"{unit} of training"
    return [*charts, chart("wall_s", seconds, run.wall_s / seconds, label)]


def _steps(
    name: str, facts: list[MotionFacts], key: str, scale: float, end: float
) -> Series:
    """How many motions were converted by when."""
    xs = sorted(f.first[key] / scale for f in facts if f.first)
    counts = [0.0, *map(float, range(1, len(xs) + 1)), float(len(xs))]
    return Series(name, [0.0, *xs, max([end, *xs])], counts)


def learning_charts(run: RunData) -> list[tuple[str, list[Markup]]]:
    """Headed groups of charts over env steps; keys that a run lacks are left out.

    A quantity of several hands is one chart, with one curve a hand.
    """
    records = run.metrics
    has_assist = any(record.get("assist/level") for record in records)
    found = [
        (heading, [chart for group in groups for chart in _charts(records, group)])
        for heading, groups in GROUPS.items()
        if heading != "Assist" or has_assist
    ]
    return [(heading, charts) for heading, charts in found if charts]


def _charts(records: list[Line], group: str) -> list[Markup]:
    y_range = (0.0, 1.0) if group == "episode" else None  # shares
    charts: dict[str, list[Series]] = {}
    for key in dict.fromkeys(key for record in records for key in record):
        first, *words = key.split("/")
        if first != group or not words or key in LEFT_OUT:
            continue
        side = next((w for w in words if w in SIDES), "")
        name = "/".join(w for w in words if w != side)
        charts.setdefault(name, []).append(_series(records, key, side))
    return [
        line_chart(series, title=name.replace("_", " "), x_label=STEPS, y_range=y_range)
        for name, series in charts.items()
    ]


def _series(records: list[Line], key: str, name: str) -> Series:
    pairs = [(r["env_steps"], r[key]) for r in records if r.get(key) is not None]
    return Series(name, [x for x, _ in pairs], [y for _, y in pairs])
