"""Runs from anybody, and runs that something happened to: one message, or no harm.

Every file of a run is spoilt in every way of ``hostile`` before a command uses the run.
"""

from __future__ import annotations

import errno
import shutil

import pytest
from gym_runs import tiny_recipe
from hostile import PLANTED, Disk, command, drawn, fingerprint

from flashdex.recipe import dump_recipe
from flashdex.system.jsonl import read_lines
from flashdex.system.run_files import (
    CHECKPOINTS,
    FILES,
    FILMS,
    FOLDERS,
    LOCK,
    METRICS,
    RECIPE,
    REPLAY,
    ROLLOUTS,
)
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.run_dir import resume, train

TIMES = ("perf/", "hours", "convert/per_hour")
INSIDE = {
    CHECKPOINTS: "000000000120.pt",
    REPLAY: "000000000120.json",
    ROLLOUTS: "both.npz",
    FILMS: "both.mp4",
}
NAMES = (
    *FILES,
    *FOLDERS,
    *(f"{folder}/{name}" for folder, name in INSIDE.items()),
    f"{REPLAY}/000000000120-0.pt",
    f"{REPLAY}/000000000999-0.pt",  # one that a resume would delete
    f"{ROLLOUTS}/both.certificate.json",
    f"{CHECKPOINTS}/000000000360.pt",
)


def recipe_of(folder):
    train = {"checkpoint_replay": True, "torch_threads": 1}
    return tiny_recipe(folder, train=train)


@pytest.fixture(scope="module")
def gym_run(tmp_path_factory):
    """A short run with two checkpoints, not to be touched."""
    folder = train(recipe_of(tmp_path_factory.mktemp("whole") / "run"))
    return resume(folder, ["total_env_steps=130"])


@pytest.fixture
def run_dir(gym_run, tmp_path):
    return shutil.copytree(gym_run, tmp_path / "run")


@pytest.fixture
def outside(tmp_path):
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "precious.pt").write_text("precious")
    return folder


def resumed(folder):
    """What a resume came to, times left out."""
    return [
        {k: v for k, v in record.items() if not k.startswith(TIMES)}
        for record in read_lines(folder / METRICS)
    ]


RESUME = ("train", "--resume", None, "total_env_steps=140")
VERBS = {"train": RESUME, "evaluate": ("evaluate", None)}


@pytest.fixture
def use(capsys, caplog):
    """Run a verb on a run."""

    def run(verb, folder, words=None):
        words = words or VERBS[verb]
        return command(capsys, caplog, *(folder if w is None else w for w in words))

    return run


@pytest.mark.parametrize("plant", PLANTED, ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_but_own_files_is_touched(name, plant, run_dir, outside, use, tmp_path):
    plant(run_dir / name, outside)
    foreign, own = fingerprint(outside), fingerprint(run_dir)
    for verb in ("evaluate", "train"):
        found = use(verb, run_dir)
        if found.code != 0:
            assert found.is_one_message(verb), found.told
            assert fingerprint(run_dir).items() <= {**own, LOCK: b""}.items()
        assert fingerprint(outside) == foreign
    # and the same where a new run would be
    shutil.rmtree(outside)
    outside.mkdir()
    plant(tmp_path / "new" / name, outside)
    foreign = fingerprint(outside)
    (tmp_path / "mine.yaml").write_text(dump_recipe(recipe_of(tmp_path / "new")))
    found = use("train", None, ("train", str(tmp_path / "mine.yaml")))
    assert found.code == 0 or found.is_one_message("train"), found.told
    assert fingerprint(outside) == foreign


@pytest.fixture
def disk(monkeypatch, tmp_path):
    return Disk(monkeypatch, tmp_path / "run")


def train_in(folder, use):
    text = dump_recipe(recipe_of(folder))
    (folder.parent / "mine.yaml").write_text(text)
    return use("train", None, ("train", str(folder.parent / "mine.yaml")))


def calls_of_a_run(disk, folder, use):
    """How many calls a whole run makes."""
    disk.fail(lambda n: False, 0)
    assert train_in(folder, use).code == 0
    shutil.rmtree(folder)
    return disk.count


CODES = (errno.ENOSPC, errno.EIO, errno.EROFS)


def check_faulty_disk(disk, folder, use, number, code, *, lasts):
    """A run whose disk fails at a call, or from it on: told, and gone on with."""
    disk.fail((lambda n: n >= number) if lasts else (lambda n: n == number), code)
    found = train_in(folder, use)
    hit = disk.count >= number
    disk.fail(lambda n: False, 0)
    where = (number, errno.errorcode[code], lasts)
    assert found.code == 0 or found.is_one_message("train"), (where, found.told)
    assert not (lasts and hit and found.code == 0 and not found.told), where
    if (folder / RECIPE).exists():
        again = use("train", folder)
        assert again.code == 0, (where, again.told)
    else:
        again = train_in(folder, use)
        assert again.code == 0, (where, again.told)
        use("train", folder)
    assert read_lines(folder / METRICS)[-1]["env_steps"] == 140, where
    assert load_checkpoint(folder)["env_steps"] == 140, where
    shutil.rmtree(folder)


@pytest.mark.parametrize("lasts", [False, True], ids=["once", "from_then_on"])
def test_a_disk_that_fails_anywhere_ends_in_one_message(disk, tmp_path, use, lasts):
    total = calls_of_a_run(disk, tmp_path / "run", use)
    draw = drawn(lasts)
    for number in draw.sample(range(1, total + 1), 8):
        code = draw.choice(CODES)
        check_faulty_disk(disk, tmp_path / "run", use, number, code, lasts=lasts)


@pytest.mark.slow
@pytest.mark.parametrize("code", CODES, ids=lambda c: errno.errorcode[c])
@pytest.mark.parametrize("lasts", [False, True], ids=["once", "from_then_on"])
def test_a_disk_that_fails_at_each_call(disk, tmp_path, use, lasts, code):
    total = calls_of_a_run(disk, tmp_path / "run", use)
    for number in range(1, total + 1):
        check_faulty_disk(disk, tmp_path / "run", use, number, code, lasts=lasts)
