"""Templates: shipped with the package, escaped throughout, complete on the disk."""

import importlib.resources
import re
import runpy
from pathlib import Path

import pytest
import setuptools
from jinja2 import UndefinedError
from markupsafe import Markup

from flashdex.errors import LibraryError
from flashdex.reports import page
from flashdex.reports.chart import Series, line_chart

TEMPLATES = Path(page.__file__).parent / "templates"
NAMES = sorted(path.name for path in TEMPLATES.iterdir())
ROOT = TEMPLATES.parents[2]
EVIL = "</text></svg><script>alert('x')</script>\" onload=\"alert(1)"


def test_templates_are_found_as_data_of_the_package():
    folder = importlib.resources.files("flashdex.reports") / "templates"
    assert {entry.name for entry in folder.iterdir()} == set(NAMES)
    assert {"run.html", "library.html", "chart.svg", "page.css", "library.js"} <= set(
        NAMES
    )


def test_templates_go_into_the_wheel(monkeypatch):
    told = {}
    monkeypatch.setattr(setuptools, "setup", told.update)
    monkeypatch.chdir(ROOT)
    runpy.run_path("setup.py")
    assert "flashdex.reports" in told["packages"]
    patterns = told["package_data"]["flashdex.reports"]
    folder = ROOT / "flashdex" / "reports"
    shipped = {path.name for pattern in patterns for path in folder.glob(pattern)}
    assert shipped >= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_templates_can_be_read_and_name_no_outside(name):
    page._ENVIRONMENT.get_template(name)
    text = (TEMPLATES / name).read_text(encoding="utf-8")
    assert not re.findall(r"https?:|url\(|@import|<link|\|\s*safe\b|autoescape", text)


def test_text_is_escaped_in_every_place_of_a_chart():
    series = [Series(EVIL, [0, 1], [0, 1]), Series("b", [0, 1], [1, 0])]
    svg = line_chart(series, title=EVIL, x_label=EVIL, y_label=EVIL)
    assert svg.count("<svg") == svg.count("</svg>") == 1
    assert "<script" not in svg
    assert 'onload="' not in svg
    assert svg.count("&lt;script&gt;") == 6  # title and y twice, name and x once


def test_markup_is_not_escaped_again_and_charts_are_markup():
    svg = line_chart([Series("a", [0], [1])], title="t", x_label="x")
    assert isinstance(svg, Markup)
    shown = page._ENVIRONMENT.from_string("{{ svg }} {{ text }}").render(
        svg=svg, text="<b>"
    )
    assert shown == f"{svg} &lt;b&gt;"


def test_long_names_break_after_an_underscore_only():
    shown = page._ENVIRONMENT.from_string("{{ name|breakable }}")
    assert shown.render(name="a_<b>_c") == "a_<wbr>&lt;b&gt;_<wbr>c"


def test_a_name_that_a_template_needs_and_lacks_is_an_error(tmp_path):
    path = tmp_path / "page.html"
    path.write_text("old")
    with pytest.raises(UndefinedError):
        page.write_page(path, "run.html", error=LibraryError, name="a")
    assert path.read_text() == "old"


def test_a_curve_joins_across_what_was_not_measured():
    nan = float("nan")
    svg = line_chart(
        [Series("a", [0, 1, 2, 4], [0, nan, 2, 4])], title="t", x_label="x"
    )
    (points,) = re.findall(r'polyline points="(.*?)"', svg)
    xs = [float(pair.split(",")[0]) for pair in points.split()]
    assert (xs[1] - xs[0]) / (xs[2] - xs[0]) == pytest.approx(0.5, abs=1e-3)


def test_axes_name_their_quantities():
    svg = line_chart(
        [Series("a", [0, 2e6], [0, 0.1])],
        title="loss",
        x_label="env steps",
        y_label="mm",
    )
    texts = re.findall(r"<text[^>]*>(.*?)</text>", svg)
    assert texts[0] == "loss, mm"
    assert texts[-1] == "env steps"  # one curve needs no legend
    assert {"0", "0.1", "2M"} <= set(texts)
