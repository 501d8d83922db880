"""Charts of a run: conversions over env steps and time, and what was learnt."""

from __future__ import annotations

from collections.abc import Iterable

from flashdex.reports.page import Html, Series, line_chart
from flashdex.reports.run.facts import Line, MotionFacts, RunData

SIDES = ("left", "right", "both")
STEPS = "env steps"
MINUTES_BELOW_S = 2 * 3600.0  # a shorter run is drawn over minutes


def conversion_charts(
    run: RunData, facts: list[MotionFacts], *, total: int
) -> list[Html]:
    """Cumulative conversions over env steps and over hours of training.

    Args:
        run: the files.
        facts: rows of the motions.
        total: motions of the collection; the axis ends there.
    """
    lines = sorted((f.first for f in facts if f.first), key=lambda x: x["env_steps"])
    unit, seconds = ("hours", 3600.0)
    if run.wall_s < MINUTES_BELOW_S:
        unit, seconds = ("minutes", 60.0)
    steps = [line["env_steps"] for line in lines]
    times = [line["wall_s"] / seconds for line in lines]
    ends = run.env_steps, run.wall_s / seconds
    labels = STEPS, f"{unit} of training"
    counts = [0.0, *map(float, range(1, len(lines) + 1)), float(len(lines))]
    return [
        Html(
            line_chart(
                [Series("converted", [0.0, *xs, max([end, *xs])], counts)],
                title="Converted motions",
                x_label=label,
                is_step=True,
                y_range=(0.0, float(max(total, 1))),
            )
        )
        for xs, end, label in zip((steps, times), ends, labels, strict=True)
    ]


def learning_charts(run: RunData) -> list[tuple[str, list[Html]]]:
    """Headed groups of charts over env steps; keys that a run lacks are left out.

    Args:
        run: the files.
    """
    records = run.metrics
    groups = [
        ("Reward terms per hand", by_side(records, "reward")),
        ("Object error while training", by_side(records, "error")),
        (
            "How episodes end, share",
            plain(records, "episode", leave={"ends"}, y_range=(0.0, 1.0)),
        ),
        ("Losses", by_side(records, "loss")),
        ("Speed and buffer", [*plain(records, "perf"), *plain(records, "buffer")]),
        ("Assist", plain(records, "assist") if _has_assist(records) else []),
    ]
    return [(heading, charts) for heading, charts in groups if charts]


def by_side(records: list[Line], group: str) -> list[Html]:
    """One chart a quantity, one curve a hand.

    Args:
        records: metrics.
        group: first word of the keys.
    """
    charts: dict[str, dict[str, str]] = {}
    for key in _keys(records, group):
        words = key.split("/")
        side = next((w for w in words[1:] if w in SIDES), "")
        name = "/".join(w for w in words[1:] if w != side)
        charts.setdefault(name, {})[side] = key
    return [
        _chart(name, [_series(records, key, side) for side, key in sides.items()])
        for name, sides in charts.items()
    ]


def plain(
    records: list[Line],
    group: str,
    *,
    leave: Iterable[str] = (),
    y_range: tuple[float, float] | None = None,
) -> list[Html]:
    """One chart a key.

    Args:
        records: metrics.
        group: first word of the keys.
        leave: names left out.
        y_range: values that are in sight in any case.
    """
    names = [key.split("/", 1)[1] for key in _keys(records, group)]
    return [
        _chart(name, [_series(records, f"{group}/{name}", "")], y_range)
        for name in names
        if name not in set(leave)
    ]


def _keys(records: list[Line], group: str) -> list[str]:
    found = dict.fromkeys(key for record in records for key in record)
    return [key for key in found if key.startswith(f"{group}/")]


def _series(records: list[Line], key: str, name: str) -> Series:
    pairs = [(r["env_steps"], r[key]) for r in records if r.get(key) is not None]
    return Series(name, [x for x, _ in pairs], [y for _, y in pairs])


def _chart(
    name: str, series: list[Series], y_range: tuple[float, float] | None = None
) -> Html:
    title = name.replace("_", " ")
    return Html(line_chart(series, title=title, x_label=STEPS, y_range=y_range))


def _has_assist(records: list[Line]) -> bool:
    return any(record.get("assist/level") for record in records)
