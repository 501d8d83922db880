"""report.html: numbers in their places, nothing unescaped, nothing from outside."""

import re
from html import unescape
from html.parser import HTMLParser

import pytest
import yaml

from flashdex.errors import RunError
from flashdex.reports.run.report import write_report
from flashdex.reports.run.terminal import run_table
from flashdex.system.jsonl import keep_lines, read_lines, write_lines
from flashdex.system.run_files import write_recipe

VOID = {"meta", "img"}


def read_report(run):
    path = write_report(run)
    assert path == run / "report.html"
    return path.read_text(encoding="utf-8")


def headline(text):
    found = re.findall(r"<div><b>(.*?)</b>(.*?)</div>", text)
    return {name: value for value, name in found}


def header(text):
    return dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))


def test_headline_and_header(run_dir):
    text = read_report(run_dir)
    assert headline(text) == {
        "converted": "1/5",  # five motions by the rate, three of them tried
        "certified": "1/1",
        "robust": "1/1",
        "strict": "1/1",
        "and trivial": "0",
        "attempts": "7",
        "deepest mm, median / max": "3.7 / 3.7",
        "force N, median / max": "12.4 / 12.4",
    }
    facts = header(text)
    assert facts["recipe"] == "tiny"
    assert facts["hand"] == "finger"
    assert facts["engine"] == "cpu"
    assert facts["seed"] == "3"
    assert facts["env steps"] == "16,000 of 50,000"
    assert facts["wall time"] == "2 min 24 s"  # 16,000 / 400,000 h
    assert facts["hardware"] == "8 cores, no GPU"
    assert facts["versions"] == "flashdex 0.1.0, mujoco 4.0"
    assert "2 more motions were not attempted yet" in text


TRIVIAL = {
    "a baseline passes": {"trivial": ["kinematic_playback"]},
    "the object hardly moves": {"trivial": ["moves_too_little"]},
}


@pytest.mark.parametrize("kind", TRIVIAL)
def test_trivial_conversions_are_counted_apart_everywhere(run_dir, kind, table_rows):
    path = run_dir / "conversions.jsonl"
    lines = read_lines(path)
    lines = [x | TRIVIAL[kind] if x["converted"] else x for x in lines]
    write_lines(path, lines)
    page = read_report(run_dir)
    found = headline(page)
    assert (found["converted"], found["and trivial"]) == ("0/5", "1")
    assert found["certified"] == found["robust"] == "0/0"
    assert table_rows(page)[0]["motion"] == "push trivial"
    said = run_table(run_dir)
    assert "0 of 5 converted by sr_mt_obj, 0 certified (0 robust, 0 strict)" in said
    assert "and 1 trivial" in said


def test_row_of_a_conversion(run_dir, certificate, table_rows):
    row = table_rows(read_report(run_dir))[0]
    assert row["motion"] == "push"
    assert row["hands"] == "left"
    assert row["attempts"] == "2"
    assert row["env steps"] == "12,345"
    assert row["minutes"] == "1.5"
    assert row["object mm (≤\u00a030)"] == "5.0"
    assert row["object deg (≤\u00a030)"] == "2.0"
    assert (row["lift ratio"], row["path ratio"]) == ("\u2013", "0.98")
    assert row["certificate"] == certificate.verdict == "robust"
    share = certificate.perturbed["pass_fraction"]["sr_mt_obj"]
    assert row["robust share"] == f"{share:.0%}"
    depth = certificate.safety["penetration_max_mm"]
    assert row["penetration mm"] == f"{depth:.1f}"
    assert row["force N"] == f"{certificate.safety['force_peak']:.1f}"
    assert row["do nothing, mm / deg"] == "63 / 11"
    assert row["playback, mm / deg"] == "7 / 4"
    assert row["failures"] == "fingertip_off left 100%"


def test_rows_of_failed_motions(run_dir, table_rows):
    evil, turn = table_rows(read_report(run_dir))[1:]
    cause = "object_dropped right 67%; never completed, furthest frame 17"
    assert evil["failures"] == cause
    assert evil["env steps"] == evil["object mm (≤\u00a030)"] == "\u2013"
    assert turn["object mm (≤\u00a030)"] == "41.2"  # the best of two, not the last
    assert turn["failures"] == "object_pos left 100%"
    assert turn["certificate"] == "\u2013"


def test_values_beyond_the_limit_are_marked(run_dir):
    text = read_report(run_dir)
    assert '<span class="bad">41.2</span>' in text
    assert "<span>11.5</span>" in text  # 0.2 rad are within 30 degrees


def test_strings_are_escaped_and_the_page_is_well_formed(run_dir):
    recipe = yaml.safe_load((run_dir / "recipe.yaml").read_text())
    recipe["name"] = '"><img src=x onerror=alert(1)>'
    write_recipe(run_dir, yaml.safe_dump(recipe))
    text = read_report(run_dir)
    assert "<script" not in text
    assert "<img src=x" not in text
    assert '<script>alert("x")</script> & co' in unescape(text)

    class Check(HTMLParser):
        def __init__(self):
            super().__init__()
            self.open = []

        def handle_starttag(self, name, attrs):
            if name not in VOID:
                self.open.append(name)

        def handle_startendtag(self, name, attrs):
            pass

        def handle_endtag(self, name):
            assert self.open.pop() == name

    check = Check()
    check.feed(text)
    assert check.open == []


def test_the_page_needs_nothing_from_outside(run_dir):
    text = read_report(run_dir)
    assert not re.findall(r"https?:|url\(|@import|<link|<script", text)
    for address in re.findall(r'(?:src|href|poster)="(.*?)"', text):
        assert address.startswith("data:")


def test_curve_of_conversions_ends_at_the_last_step(run_dir):
    text = read_report(run_dir)
    charts = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    by_steps, by_time = charts[:2]
    assert "env steps" in by_steps
    assert "minutes of training" in by_time
    points = re.search(r'polyline points="(.*?)"', by_steps).group(1).split()
    xs, ys = zip(*((float(v) for v in p.split(",")) for p in points), strict=True)
    # 0 -> 1 at 12,345 of 16,000 env steps, one of five motions: 1/5 of the axis
    assert (xs[2] - xs[0]) / (xs[-1] - xs[0]) == pytest.approx(
        12_345 / 16_000, abs=1e-3
    )
    ticks = re.findall(r'text-anchor="end">(\d+)<', by_steps)
    assert (ticks[0], ticks[-1]) == ("0", "5")
    assert (ys[0] - ys[-1]) / (230 - 40 - 32) == pytest.approx(1 / 5, abs=1e-3)


def test_learning_curves_are_there(run_dir):
    text = read_report(run_dir)
    for heading in ("Reward terms per hand", "How episodes end, share", "Losses"):
        assert f"<h2>{heading}</h2>" in text
    chart = next(c for c in re.findall(r"<svg.*?</svg>", text) if "wrist pos" in c)
    assert chart.count("<polyline") == 2
    assert ">left<" in chart
    assert ">right<" in chart


def test_a_run_without_anything_yet(empty_run):
    text = read_report(empty_run)
    assert headline(text)["converted"] == "0/0"
    assert "No motion has been attempted yet" in text
    assert "<h2>Films</h2>" not in text


def test_a_run_without_conversions(run_dir):
    keep_lines(run_dir / "conversions.jsonl", lambda line: not line["converted"])
    text = read_report(run_dir)
    # the files of the rollout are there, but no line claims it
    assert headline(text)["certified"] == "0/0"
    assert "<h2>Films</h2>" not in text
    assert "robust</span>" not in text


def test_a_run_without_baselines(run_dir, table_rows):
    (run_dir / "baselines.json").unlink()
    text = read_report(run_dir)
    assert "Baselines were not run" in text
    row = table_rows(text)[0]
    assert row["motion"] == "push"
    assert not [key for key in row if "playback" in key]


def test_a_conversion_without_certificate_says_so(run_dir, table_rows):
    (run_dir / "rollouts" / "push.certificate.json").unlink()
    lines = read_lines(run_dir / "conversions.jsonl")
    for line in lines:
        line.pop("verdict", None)
    write_lines(run_dir / "conversions.jsonl", lines)
    page = read_report(run_dir)
    assert headline(page)["certified"] == "0/1"
    assert table_rows(page)[0]["certificate"] == "none"
    assert table_rows(page)[0]["robust share"] == "\u2013"


def test_promises_of_the_recipe(run_dir):
    recipe = yaml.safe_load((run_dir / "recipe.yaml").read_text())
    recipe["expect"] = [
        {"metric": "convert/cumulative", "at_env_steps": 9_000, "min": 1, "max": None},
        {"metric": "convert/cumulative", "at_env_steps": 90_000, "min": 2, "max": None},
    ]
    write_recipe(run_dir, yaml.safe_dump(recipe))
    text = read_report(run_dir)
    assert "convert/cumulative min 1 at 9,000 env steps. Found: 1.000." in text
    assert "min 2 at 90,000 env steps. Found: not reached yet." in text


def test_a_line_cut_by_a_crash_is_left_out_and_a_broken_one_is_named(run_dir):
    path = run_dir / "conversions.jsonl"
    whole = path.read_text()
    path.write_text(whole + '{"motion": "pu')
    assert headline(read_report(run_dir))["attempts"] == "7"
    path.write_text('{"motion": "pu\n' + whole)
    with pytest.raises(RunError, match=r"conversions\.jsonl: line 1 has no seal"):
        write_report(run_dir)
    write_lines(path, [{"motion": "push"}])
    with pytest.raises(RunError, match="line 1 lacks 'converted'"):
        write_report(run_dir)


def test_what_a_resumed_run_did_twice_is_drawn_once(run_dir):
    path = run_dir / "metrics.jsonl"
    lines = read_lines(path)
    again = {**lines[1], "env_steps": 9_000.0, "hours": 0.05}
    write_lines(path, [*lines, again])
    assert header(read_report(run_dir))["wall time"] == "3 min 00 s"
    chart = next(
        c
        for c in re.findall(r"<svg.*?</svg>", (run_dir / "report.html").read_text())
        if "wrist pos" in c
    )
    points = re.search(r'polyline points="(.*?)"', chart).group(1).split()
    assert len(points) == 3  # 1,000 and 8,000 and 9,000: 16,000 was thrown away


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(RunError, match="not a run directory"):
        write_report(tmp_path)
