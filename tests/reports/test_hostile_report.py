"""Reports of runs from anybody: only own files, of the right kind, are shown."""

from __future__ import annotations

import pytest
from hostile import CONTENT, PLANTED, command, drawn, fingerprint

from flashdex.reports.render import films
from flashdex.reports.render.films import Film
from flashdex.system.run_files import FILES, FILMS, FOLDERS, REPORT, ROLLOUTS

PICTURE = b"\x89PNG\r\n\x1a\n" + bytes(40)
MP4 = b"\0\0\0 ftypisom" + bytes(40)
NAMES = (
    *FILES,
    *FOLDERS,
    *(f"{FILMS}/push{end}" for end in (".mp4", ".png", "~poster.png")),
    *(f"{ROLLOUTS}/push{end}" for end in (".npz", ".certificate.json")),
)


@pytest.fixture
def filmed(run_dir):
    """The run with a film that looks like one."""
    film = Film.of(run_dir / ROLLOUTS / "push.npz")
    film.video.parent.mkdir()
    for path, content in ((film.video, MP4), (film.stills, PICTURE)):
        path.write_bytes(content)
    film.poster.write_bytes(PICTURE)
    return run_dir


@pytest.fixture
def report(capsys, caplog):
    return lambda folder: command(capsys, caplog, "report", folder)


@pytest.mark.parametrize("plant", PLANTED, ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_but_own_files_is_shown(name, plant, filmed, report, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    plant(filmed / name, outside)
    foreign = fingerprint(outside)
    found = report(filmed)
    assert fingerprint(outside) == foreign
    if (
        name in FOLDERS
        and (filmed / name).is_dir()
        and not (filmed / name).is_symlink()
    ):
        return  # an empty folder of its own
    assert found.is_one_message("report"), found.told
    assert not (filmed / REPORT).is_file() or name == REPORT


def test_a_film_is_shown(filmed, report):
    assert report(filmed).code == 0
    assert (filmed / REPORT).read_text().count("data:") == 3


@pytest.mark.parametrize("end", [".mp4", ".png", "~poster.png"])
@pytest.mark.parametrize("fault", ["another kind", "too large", "empty"])
def test_what_is_no_film_is_not_shown(filmed, report, monkeypatch, end, fault):
    path = filmed / FILMS / f"push{end}"
    if fault == "too large":
        monkeypatch.setattr(films, "MAX_BYTES", 50)
        path.write_bytes(path.read_bytes() + bytes(60))
    else:
        path.write_bytes(b"root:x:0:0" * 10 if fault == "another kind" else b"")
    assert report(filmed).code == 0
    page = (filmed / REPORT).read_text()
    assert "data:" not in page
    assert "No films of this run" in page


@pytest.mark.parametrize("spoil", CONTENT, ids=lambda f: f.__name__)
@pytest.mark.parametrize(
    "name",
    [
        *("recipe.yaml", "versions.json", "baselines.json", "conversions.jsonl"),
        *("metrics.jsonl", f"{ROLLOUTS}/push.certificate.json"),
    ],
)
def test_a_spoilt_file_ends_in_one_message_at_most(name, spoil, filmed, report):
    spoil(filmed / name, drawn(name))
    found = report(filmed)
    assert found.code == 0 or found.is_one_message("report"), found.told
