"""Charts: ticks by hand, and curves measured in the SVG."""

import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import pytest

from flashdex.reports.chart import (
    HEIGHT,
    WIDTH,
    Series,
    format_tick,
    line_chart,
    nice_ticks,
)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 97, [0, 20, 40, 60, 80, 100]),
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        (-0.1, 0.1, [-0.1, -0.05, 0, 0.05, 0.1]),
        (0, 300e6, [0, 100e6, 200e6, 300e6]),
        (0, 0, [0, 0.2, 0.4, 0.6, 0.8, 1]),
    ],
)
def test_ticks_are_round_and_cover(low, high, expected):
    assert nice_ticks(low, high) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("low", "high"), [(5, 5), (-3, -3), (1e9, 1e9 + 1e-6), (0, 1e-30)]
)
def test_ticks_of_a_narrow_range(low, high):
    ticks = nice_ticks(low, high)
    assert 2 <= len(ticks) <= 12
    assert ticks[0] <= low <= high <= ticks[-1] + 1e-6


def test_short_numbers():
    values = [0, 0.04, 999, 2_500, 300e6, -1_000]
    assert [format_tick(v) for v in values] == [
        "0",
        "0.04",
        "999",
        "2.5k",
        "300M",
        "-1k",
    ]


def points_of(svg):
    found = ET.fromstring(svg).findall("polyline")
    return [
        [tuple(map(float, pair.split(","))) for pair in line.get("points").split()]
        for line in found
    ]


def test_a_curve_is_where_its_values_are():
    svg = line_chart([Series("a", [0, 5, 10], [0, 1, 4])], title="t", x_label="x")
    (first, middle, last) = points_of(svg)[0]
    assert middle[0] == pytest.approx((first[0] + last[0]) / 2, abs=0.1)
    assert (first[1] - middle[1]) == pytest.approx((first[1] - last[1]) / 4, abs=0.2)
    ticks = [
        e for e in ET.fromstring(svg).findall("text") if e.get("text-anchor") == "end"
    ]
    labels = {e.text: float(e.get("y")) for e in ticks}
    assert labels["4"] - 4 == pytest.approx(last[1], abs=0.1)  # text sits 4 lower
    for x, y in (first, middle, last):
        assert 0 <= x <= WIDTH
        assert 0 <= y <= HEIGHT


def test_steps_hold_their_value():
    svg = line_chart(
        [Series("a", [0, 5, 10], [0, 1, 2])], title="", x_label="", is_step=True
    )
    (curve,) = points_of(svg)
    assert len(curve) == 5
    assert all(a[0] == b[0] or a[1] == b[1] for a, b in pairwise(curve))


def test_values_that_are_not_finite_are_left_out():
    values = [1.0, float("nan"), float("inf"), 3.0]
    svg = line_chart([Series("a", [0, 1, 2, 3], values)], title="", x_label="")
    assert len(points_of(svg)[0]) == 2
    assert "nan" not in svg
    empty = line_chart([Series("a", [0], [float("nan")])], title="", x_label="")
    assert "no data yet" in empty


def test_a_single_point_is_seen():
    svg = line_chart([Series("a", [7], [3])], title="", x_label="")
    assert len(ET.fromstring(svg).findall("circle")) == 1


def test_a_long_run_is_thinned_without_a_shift():
    x = list(range(10_000))
    svg = line_chart([Series("a", x, [float(v) for v in x])], title="", x_label="")
    (curve,) = points_of(svg)
    assert len(curve) <= 300
    slopes = {round((b[1] - a[1]) / (b[0] - a[0]), 1) for a, b in pairwise(curve)}
    assert len(slopes) <= 2  # still a straight line


def test_names_are_escaped_and_curves_differ_without_colour():
    series = [Series("<a>", [0, 1], [0, 1]), Series("b&", [0, 1], [1, 0])]
    svg = line_chart(series, title="<t>", x_label='"x"')
    texts = [e.text for e in ET.fromstring(svg).findall("text")]
    assert {"<t>", "<a>", "b&", '"x"'} <= set(texts)
    dashes = re.findall(r'<polyline[^>]*stroke-dasharray="(.*?)"', svg)
    assert len(set(dashes)) == 2
