"""report.html of a library: every recording in it, nothing of a name becomes markup."""

import base64
import csv
import io
import re
import shutil
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from mutations import KINDS
from PIL import Image
from synthetic import data_of, forge_library, write_library

from flashdex.errors import LibraryError
from flashdex.motions import library_check
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import read_manifest
from flashdex.reports.library import report as library_report
from flashdex.reports.library.charts import (
    contact_timeline,
    histogram,
    motion_charts,
)
from flashdex.reports.library.facts import CODES, RecordingFacts, library_facts
from flashdex.reports.library.report import summary_lines, write_library_report
from flashdex.reports.render.films import NO_GRAPHICS, find_backend
from flashdex.reports.render.stills import contact_of, draw_thumbnails, still_frames

EVIL = '"><script>alert("x")<img src=x onerror=alert(1)> & co'
EVIL_REASON = "E_DEMO: <b onclick='x'>a/b.npz</b>: \x1b[2J no key"
VOID = {"meta", "img", "input", "wbr"}
SPIKE = 0.123  # m, one frame of tip error


def write_rows(path, rows):
    columns = dict.fromkeys(key for row in rows for key in row)
    with (path / "report.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def recording(name, status, reason="", **figures):
    return {"motion": name, "status": status, "reason": reason, **figures}


def good(name, status="kept", reason="", **figures):
    usual = {"seconds": 0.667, "hands": "right", "objects": "box"}
    usual |= {"tip_error_median_mm": 4.0, "tip_error_p95_mm": 12.0}
    usual |= {"penetration_p95_mm": 2.25, "penetration_max_mm": 3.0}
    return recording(name, status, reason, source="made", **usual | figures)


@pytest.fixture
def plain(library, tmp_path):
    """The synthetic library under a name of its own, as an older version wrote it."""
    path = tmp_path / "mine"
    shutil.copytree(library.path, path)
    return MotionLibrary.load(path)


def measure(record):
    """Tip errors of 4 mm with one spike, 2 mm deep, right fingers close at frame 6."""
    total = len(record.frames["joint_pos"])
    error = np.full((total, 2, 5), 0.004)
    contact = np.zeros((total, 2, 5), dtype=bool)
    if record.name == "right_box":
        error[10, 1, 2] = SPIKE
        contact[6:, 1, :] = True
    else:
        contact[:, 1, :] = True
    depth = np.full(total, 0.002)
    record.quality = {"tip_error": error, "penetration": depth, "contact": contact}


def rename(record):
    record.name, record.info = EVIL, {"licence": "CC <0>"}


@pytest.fixture(scope="module")
def measured(hands, tmp_path_factory):
    changes = {"right_box": [measure], "left_ball": [measure, rename]}
    changes["both"] = [measure]
    path = tmp_path_factory.mktemp("measured") / "mine"
    return write_library(path, hands, changes=changes, manifest={"source": "made"})


@pytest.fixture
def mine(measured, tmp_path):
    """Three motions, one flagged and of a hostile name, and three rejected."""
    path = tmp_path / "mine"
    shutil.copytree(measured.path, path)
    rows = [
        good("right_box"),
        recording(EVIL, "rejected", EVIL_REASON),
        good(EVIL, "flagged", "W_IK: off; W_WATER: hull; W_IK: too", seconds=0.517),
        recording("short", "rejected", "R_SHORT: 0.50 s < 1.0 s; W_WATER: a"),
        good("both", tip_error_p95_mm=30.0, hands="left right", seconds=0.867),
        recording("again", "rejected", "R_SHORT: 0.20 s < 1.0 s", source="other"),
    ]
    rows[2]["tip_error_p95_mm"] = 48.0
    write_rows(path, rows)
    return MotionLibrary.load(path)


@pytest.fixture
def backend():
    if find_backend() is None:
        pytest.skip("no off-screen graphics: install libosmesa6 or libegl1")


class Page(HTMLParser):
    """Elements with their attributes, cells of the recordings, checked nesting."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.rows, self.cell = [], [], [], None
        self.inside = False
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, name, attrs):
        self.elements.append((name, dict(attrs)))
        if name not in VOID:
            self.open.append(name)
        self.inside |= name == "table" and dict(attrs).get("id") == "recordings"
        if self.inside and name == "tr":
            self.rows.append([])
        if self.inside and name in ("td", "th"):
            self.rows[-1].append("")

    def handle_startendtag(self, name, attrs):
        if name not in ("polyline", "line", "circle", "rect"):
            self.elements.append((name, dict(attrs)))

    def handle_endtag(self, name):
        assert self.open.pop() == name
        self.inside &= name != "table"

    def handle_data(self, data):
        if self.inside and ("td" in self.open or "th" in self.open):
            self.rows[-1][-1] += data


def write(library, **options):
    options = {"thumbnails": False, **options}
    path = write_library_report(library, **options)
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def records(page):
    heads, *rows = page.rows
    return [dict(zip(heads, row, strict=True)) for row in rows]


def chart(text, name):
    return re.search(rf'<svg[^>]*aria-label="{name}.*?</svg>', text, re.DOTALL).group()


def curve(svg, index=0):
    """Values of a polyline by the ticks of the y axis, and its x in pixels."""
    ticks = re.findall(r'y="([\d.]+)" text-anchor="end">([^<]*)<', svg)
    (y0, v0), (y1, v1) = [(float(y) - 4, float(v)) for y, v in (ticks[0], ticks[-1])]
    found = re.findall(r'polyline points="(.*?)"', svg)[index].split()
    points = [tuple(map(float, pair.split(","))) for pair in found]
    return [(x, v0 + (y - y0) / (y1 - y0) * (v1 - v0)) for x, y in points]


def test_headline_counts_every_recording(mine):
    text, _ = write(mine)
    boxes = {n: v for v, n in re.findall(r"<div><b>(.*?)</b>(.*?)</div>", text)}
    assert boxes == {
        "kept": "2/6",
        "flagged": "1/6",
        "rejected": "3/6",
        "seconds of motion": "2",  # 40 + 31 + 52 frames at 60 Hz
    }
    told = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    assert (told["hand"], told["rate"], told["motions"]) == ("xhand", "60 Hz", "3")
    cells = re.findall(r'data-label="(\w+)">(.*?)</td>', text)
    sources = [dict(cells[:7]), dict(cells[7:14])]
    assert sources[0]["source"] == "made"
    assert sources[0]["licence"] == "CC &lt;0&gt;"
    assert (sources[0]["recordings"], sources[0]["rejected"]) == ("5", "2")
    assert sources[0]["seconds"] == "2.1"  # 0.667 + 0.517 + 0.867
    assert (sources[1]["source"], sources[1]["kept"]) == ("other", "0")


def test_the_table_has_every_recording_and_column_worst_first(mine):
    _, page = write(mine)
    found = records(page)
    names = [row["motion"] for row in found]
    assert names == [EVIL, "short", "again", EVIL, "both", "right_box"]
    assert [r["status"] for r in found[:4]] == ["rejected"] * 3 + ["flagged"]
    assert found[1]["reason"] == "R_SHORT: 0.50 s < 1.0 s; W_WATER: a"
    assert found[1]["seconds"] == ""
    written = list(csv.DictReader((mine.path / "report.csv").open(newline="")))
    assert set(found[0]) == set(written[0])
    both = next(row for row in written if row["motion"] == "both")
    assert found[4] == both


def test_names_and_reasons_never_become_markup(mine):
    text, page = write(mine)
    names = [name for name, _ in page.elements]
    assert names.count("script") == 1  # the page's own
    assert "img" not in names
    assert names.count("b") == 4  # the numbers at the top
    assert not [a for _, a in page.elements for key in a if key.startswith("on")]
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL).group(1)
    assert "alert" not in script
    assert "innerHTML" not in script
    reasons = [row["reason"] for row in records(page)]
    assert EVIL_REASON in reasons


def test_the_page_needs_nothing_from_outside(mine):
    text, page = write(mine)
    assert not re.findall(r"https?:|url\(|@import|<link", text)
    ids = {attrs["id"] for _, attrs in page.elements if "id" in attrs}
    for _, attrs in page.elements:
        assert attrs.get("src", "data:").startswith("data:")
        if "href" in attrs:
            assert attrs["href"][0] == "#"
            assert attrs["href"][1:] in ids


def test_codes_are_counted_once_a_recording(mine):
    text, _ = write(mine)
    counts = {
        code: re.findall(r"<td[^>]*>(\d+)</td>", line)
        for code, line in re.findall(r'data-code="(\w+)">(.*?)</tr>', text)
    }
    assert counts == {
        "W_WATER": ["0", "1", "1"],  # kept, flagged, rejected
        "R_SHORT": ["0", "0", "2"],
        "W_IK": ["0", "1", "0"],
        "E_DEMO": ["0", "0", "1"],
    }
    assert CODES["R_SHORT"] in text


def test_every_documented_code_has_a_meaning():
    docs = Path(library_report.__file__).parents[3] / "docs" / "data.md"
    documented = set(re.findall(r"^\| `([EWRI]_\w+)` \|", docs.read_text(), re.M))
    assert len(documented) > 10
    assert documented <= set(CODES)


def test_the_outcome_of_a_rejected_namesake_is_not_mixed_up(mine):
    facts = library_facts(mine)
    twins = [one for one in facts if one.name == EVIL]
    assert [one.row for one in twins] == [None, 1]
    assert twins[1].codes == ["W_IK", "W_WATER"]
    assert twins[1].badness == pytest.approx(48 / 40)


def test_histogram_holds_every_motion():
    values = [1.0, 1.5, 2.0, 7.0, 7.5, 9.9]
    facts = [
        RecordingFacts(str(v), "kept", "", {"tip_error_p95_mm": str(v)}) for v in values
    ]
    facts.append(RecordingFacts("none", "kept", "", {"tip_error_p95_mm": ""}))
    points = curve(histogram(facts, "tip_error_p95_mm"))
    heights = [v for (x, v), (x1, _) in pairwise(points) if x1 > x]
    assert sum(heights) == pytest.approx(len(values), abs=0.05)
    assert "median 4.5, p95 9.3, largest 9.9" in histogram(facts, "tip_error_p95_mm")


def test_one_wild_value_does_not_squeeze_the_histogram():
    values = [*np.linspace(1, 10, 30), 5_000.0]
    facts = [RecordingFacts("m", "kept", "", {"seconds": str(v)}) for v in values]
    points = curve(histogram(facts, "seconds"))
    heights = [v for (x, v), (x1, _) in pairwise(points) if x1 > x]
    assert sum(heights) == pytest.approx(31, abs=0.2)
    assert max(heights) < 10  # not all in the first bin


def test_the_card_shows_a_fault_of_one_frame(mine):
    text, _ = write(mine)
    cards = text.split('<section class="card">')
    card = next(part for part in cards if 'id="motion-0"' in part)
    svg = chart(card, "worst tip error, mm")
    assert ">left<" not in svg  # only the right hand takes part
    values = [v for _, v in curve(svg)]
    assert max(values) == pytest.approx(1e3 * SPIKE, rel=0.01)
    assert sorted(values)[-2] == pytest.approx(4.0, abs=0.5)
    depth = [v for _, v in curve(chart(card, "hand in objects, mm"))]
    assert np.allclose(depth, 2.0, atol=0.05)


def test_long_motions_keep_their_peaks(mine):
    long = MotionLibrary.load(mine.path)
    assert long.quality is not None
    frames = 123  # all of the frame axis as one motion, repeated tenfold
    long.frames = torch.cat([long.frames.clone()] * 10)
    long.quality = torch.cat([long.quality.clone()] * 10)
    long.quality["penetration"][777] = 0.05
    long.motions = long.motions[:1].clone()
    long.motions["length"][0] = 10 * frames
    svg = next(c for c in motion_charts(long, 0) if "hand in objects" in c)
    points = curve(svg)
    assert len(points) <= 300
    assert max(v for _, v in points) == pytest.approx(50, abs=0.3)


def test_contact_bars_are_where_the_fingers_touch():
    contact = np.zeros((101, 2, 5), dtype=bool)
    contact[20:50, 1, 0] = True  # right thumb
    contact[80:, 0, 4] = True  # left pinky, until the end
    svg = contact_timeline(contact, fps=10.0)
    found = r'y="([\d.]+)" text-anchor="end" font-size="10">(.*?)<'
    labels = {name: float(y) for y, name in re.findall(found, svg)}
    assert len(labels) == 10
    assert labels["L pinky"] < labels["R thumb"]  # left hand above
    bars = [
        tuple(map(float, bar))
        for bar in re.findall(
            r'<rect x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)"', svg
        )
    ]
    assert len(bars) == 2
    wide = 400 - 54 - 14
    for bar, (start, stop, label) in zip(
        bars, [(8.0, 10.0, "L pinky"), (2.0, 5.0, "R thumb")], strict=True
    ):
        x, y, width, height = bar
        assert x == pytest.approx(54 + start / 10 * wide, abs=0.1)
        assert width == pytest.approx((stop - start) / 10 * wide, abs=0.1)
        assert y < labels[label] < y + height + 1.5


def test_without_stored_quality_contacts_still_follow_from_distances(plain):
    text, _ = write(plain)
    assert "Errors over time were not stored" in text
    assert "worst tip error" not in text
    assert text.count('aria-label="human fingers in contact"') == 3
    plain.frames = plain.frames.clone()
    gaps = plain.frames["tip_dist"]
    gaps[:40] = 0.05
    gaps[5:30, :, 2] = 0.01
    expected = np.zeros((40, 2, 5), dtype=bool)
    expected[5:30, 1, 2] = True  # the left hand takes no part
    assert (contact_of(plain, 0) == expected).all()


def test_a_library_without_report_shows_its_manifest(plain):
    (plain.path / "report.csv").unlink()
    _, page = write(plain)
    names = {row["motion"]: row["seconds"] for row in records(page)}
    assert names == {"right_box": "0.667", "left_ball": "0.517", "both": "0.867"}


def test_only_the_worst_have_a_card_and_the_page_says_so(mine):
    text, page = write(mine, max_cards=1)
    cards = [a for n, a in page.elements if a.get("class") == "card"]
    assert len(cards) == 1
    assert 'id="motion-1"' in text  # the flagged one
    assert "The 1 flagged or worst of 3 motions" in text
    assert len(records(page)) == 6


def test_two_thousand_recordings_are_a_light_page(mine):
    names = [f"clip_{i:04d}" for i in range(2000)]
    rows = [
        good(n, "flagged", "W_PEN: a fingertip is 13 mm inside the object")
        for n in names
    ]
    write_rows(mine.path, rows)
    text, page = write(mine)
    assert len(records(page)) == 2003  # and those that only the manifest names
    assert len(text) < 2e6


def test_a_report_that_is_no_table_is_refused(mine):
    cell = "x" * (csv.field_size_limit() + 1)
    (mine.path / "report.csv").write_text(f"motion,status\n{cell},kept\n")
    with pytest.raises(LibraryError, match=r"report\.csv: not a readable table"):
        write_library_report(mine, thumbnails=False)


@pytest.mark.parametrize("kind", ["link", "dangling", "folder", "fifo"])
def test_a_report_that_is_no_file_of_the_library_is_not_shown(
    mine, tmp_path, monkeypatch, kind
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    KINDS[kind](mine.path / "report.csv", np.random.default_rng(0))
    with pytest.raises(LibraryError, match=r"report\.csv: not a readable table"):
        write_library_report(mine, thumbnails=False)


def test_cells_beyond_the_heading_are_left_out(mine):
    (mine.path / "report.csv").write_text("motion,status\nlift,rejected,a,b\n")
    _, page = write(mine)
    assert records(page)[0]["motion"] == "lift"


def test_a_page_that_cannot_be_written(mine, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LibraryError, match="cannot be written"):
        write_library_report(mine, tmp_path / "file" / "report.html", thumbnails=False)


def test_the_page_goes_where_it_is_asked_to(mine, tmp_path):
    path = tmp_path / "elsewhere" / "page.html"
    assert write_library_report(mine, path, thumbnails=False) == path
    assert path.is_file()
    assert not (mine.path / "report.html").exists()


def test_stills_are_taken_at_first_contact(mine):
    assert still_frames(mine, 0) == {"start": 0, "contact": 6, "middle": 20, "end": 39}
    mine.quality["contact"][:] = False
    words = still_frames(mine, 1)
    assert words == {"start": 0, "quarter": 7, "middle": 15, "end": 30}


def test_pictures_show_objects_and_hands(mine, backend):
    text, _ = write(mine, thumbnails=True)
    strips = re.findall(r'<img src="data:image/jpeg;base64,(.*?)"', text)
    assert len(strips) == 3
    assert sum(map(len, strips)) < 3 * 80_000  # a hundred motions stay below 8 MB
    assert '<figcaption class="four"><span>start 0.00 s</span>' in text
    # the worst first: the flagged ball, then both, then the box
    for data in strips:
        strip = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
        assert strip.size == (4 * 256, 192)
        pixels = np.asarray(strip).astype(int)
        for still in np.split(pixels, 4, axis=1):
            red, green, blue = (still[..., i] for i in range(3))
            assert (red > blue + 60).sum() > 50  # the object
            grey = (abs(red - green) < 12) & (abs(green - blue) < 12)
            assert (grey & (red < 140)).sum() > 300  # the hand


def test_a_motion_that_cannot_be_drawn_does_not_spoil_the_others(
    plain, backend, tmp_path, monkeypatch
):
    # a surface that MuJoCo takes for no mesh, in a library that counts as checked
    monkeypatch.setenv("FLASHDEX_CACHE", str(tmp_path / "cache"))
    file = data_of(plain.path) / plain.manifest["objects"][0]["visual"]
    file.write_text("v 0 0 0\n" * 4 + "f 1 2 3\n")
    forge_library(plain.path, lambda entries, arrays: None)
    mark = library_check._mark(plain.path, read_manifest(plain.path))
    mark.parent.mkdir(parents=True)
    mark.touch()
    drawn, fault = draw_thumbnails(MotionLibrary.load(plain.path), [0, 1])
    assert list(drawn) == [1]
    assert fault.startswith("no pictures of 1 of 2 motions: right_box: ")


def test_without_graphics_the_report_says_so(mine, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_back_end")
    find_backend.cache_clear()
    text, _ = write(mine, thumbnails=True)
    find_backend.cache_clear()
    assert NO_GRAPHICS in text
    assert "<img" not in text
    assert text.count('<section class="card">') == 3


def test_summary_counts_codes_sources_and_the_worst(mine):
    lines = summary_lines(mine)
    text = "\n".join(lines)
    head = "6 recordings: 2 kept, 1 flagged, 3 rejected; 0 min 02 s of motion"
    assert lines[0] == head
    assert re.search(r"^made +2 +1 +2 +2\.1$", text, re.M)
    assert re.search(r"^other +0 +0 +1 +0\.0$", text, re.M)
    assert re.search(r"^R_SHORT +0 +0 +2 under 1 s$", text, re.M)
    worst = lines[next(i for i, x in enumerate(lines) if x.startswith("worst")) + 1 :]
    assert "48.0" in worst[0]
    assert worst[0].endswith("W_IK W_WATER")
    assert worst[1].startswith("both")
    assert max(map(len, lines)) <= 100


def test_summary_of_rows_before_anything_is_written():
    rows = [recording(f"bad\x1b[31m{i}\n", "rejected", "E_X: \x07") for i in range(3)]
    rows.append(good("fine", tip_error_p95_mm=float("nan")))
    lines = summary_lines(rows)
    assert lines[0].startswith("4 recordings: 1 kept, 0 flagged, 3 rejected")
    assert any(re.match(r"E_X +0 +0 +3", line) for line in lines)
    assert all(line.isprintable() for line in lines)
    names = [good(f"m\x1b{i}\n", tip_error_p95_mm=10 * i) for i in range(9)]
    shown = [line for line in summary_lines(names) if line.startswith("m?")]
    assert [line[2] for line in shown] == ["8", "7", "6", "5", "4"]
