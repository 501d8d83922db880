"""Atomic writes: the whole new file or the old one, and nothing beside it."""

import errno
import os
import subprocess
import sys

import pytest

from flashdex.errors import RunError
from flashdex.system.files import (
    open_atomic,
    own_file,
    own_files,
    own_folder,
    run_lock,
    waiting_lock,
    write_atomic,
)

HOLD = """
import sys, time
from pathlib import Path
from flashdex.system import files
with getattr(files, sys.argv[1])(Path(sys.argv[2])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_file_is_replaced_and_no_temporary_one_stays(tmp_path):
    path = tmp_path / "new" / "a.json"
    for text in ("one", "zw\u00f6lf\n"):
        write_atomic(path, text)
        assert path.read_bytes() == text.encode("utf-8")
    assert os.listdir(path.parent) == ["a.json"]


def test_a_write_that_fails_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half():
        with open_atomic(path) as file:
            file.write(b"half of the n")
            file.flush()
            assert path.read_bytes() == b"old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_files_have_the_permissions_of_ordinary_ones(tmp_path):
    write_atomic(tmp_path / "a", "")
    (tmp_path / "b").write_text("")
    modes = [(tmp_path / name).stat().st_mode for name in "ab"]
    assert modes[0] == modes[1]


@pytest.fixture
def hold():
    """Start a process that holds a lock; killed at the end."""
    started = []

    def start(name, path):
        words = [sys.executable, "-c", HOLD, name, str(path)]
        child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        started.append(child)
        assert child.stdout.readline() == "held\n"
        return child

    yield start
    for child in started:
        child.kill()
        child.communicate()


def test_a_run_is_held_by_one_process_and_freed_by_its_death(hold, tmp_path):
    child = hold("run_lock", tmp_path)
    with pytest.raises(RunError, match="another process is training"):
        run_lock(tmp_path).__enter__()
    child.kill()
    child.wait()
    with run_lock(tmp_path):
        pass


def test_a_second_process_waits_for_what_is_being_made(hold, tmp_path):
    child = hold("waiting_lock", tmp_path / "new" / "asset")
    words = [sys.executable, "-c", HOLD, "waiting_lock", str(child.args[-1])]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as second:
        os.set_blocking(second.stdout.fileno(), False)
        with pytest.raises(subprocess.TimeoutExpired):
            second.wait(timeout=3)
        assert not second.stdout.readline()
        child.kill()
        os.set_blocking(second.stdout.fileno(), True)
        assert second.stdout.readline() == "held\n"
        second.kill()


def test_a_disk_that_refuses_to_unlock_keeps_nobody_out(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    real = fcntl.flock

    def refuse(handle, how):
        if how == fcntl.LOCK_UN:
            raise OSError(errno.EIO, "Input/output error")
        real(handle, how)

    monkeypatch.setattr(fcntl, "flock", refuse)
    for _ in range(2):
        with waiting_lock(tmp_path / "asset"):
            pass


def test_a_folder_that_cannot_be_made_is_worked_in_without_a_lock(tmp_path):
    (tmp_path / "file").write_text("")
    with waiting_lock(tmp_path / "file" / "asset"):
        (tmp_path / "worked").touch()
    assert sorted(os.listdir(tmp_path)) == ["file", "worked"]


def test_own_files_lie_below_their_folder(tmp_path):
    root = tmp_path / "run"
    (root / "deep" / "er").mkdir(parents=True)
    for name in ("a", "deep/b", "deep/er/c"):
        (root / name).write_text(name)
        assert own_file(root, name).read_text() == name
    assert own_file(root, "new", "file") == root / "new" / "file"
    assert [p.name for p in own_files(root, "deep", "b*")] == ["b"]
    (tmp_path / "moved").symlink_to(root)  # the user's own choice
    assert own_file(tmp_path / "moved", "deep", "b").read_text() == "deep/b"


ELSEWHERE = ["../b", "deep/../../b", "/etc/passwd", "", ".", "a\0b", "x" * 300, "a/b"]


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_path_that_leaves_the_folder_is_refused(tmp_path, name):
    root = tmp_path / "run"
    (root / "deep").mkdir(parents=True)
    (root / "a").write_text("a file, no folder")
    (tmp_path / "b").write_text("elsewhere")
    with pytest.raises(RunError, match="run"):
        own_file(root, name)


@pytest.mark.parametrize("kind", ["link", "dangling", "folder link", "pipe", "folder"])
def test_only_regular_files_are_ones_own(tmp_path, kind):
    root, other = tmp_path / "run", tmp_path / "other"
    root.mkdir()
    other.mkdir()
    (other / "b").write_text("keep")
    names = {"folder link": "sub/b"}
    if kind == "pipe":
        os.mkfifo(root / "b")
    elif kind == "folder":
        (root / "b").mkdir()
    elif kind == "folder link":
        (root / "sub").symlink_to(other)
        with pytest.raises(RunError, match="a link, not a folder of its own"):
            own_folder(root, "sub")
    else:
        (root / "b").symlink_to(other / ("b" if kind == "link" else "nothing"))
    with pytest.raises(RunError, match="of its own"):
        own_file(root, names.get(kind, "b"))
    assert own_folder(root, "new").is_dir()


def test_a_link_under_the_name_of_a_temporary_file_is_not_followed(tmp_path):
    (tmp_path / "other").write_text("keep")
    (tmp_path / f".a.{os.getpid()}.tmp").symlink_to(tmp_path / "other")
    write_atomic(tmp_path / "a", "new")
    assert (tmp_path / "other").read_text() == "keep"
    assert (tmp_path / "a").read_text() == "new"
    assert not (tmp_path / "a").is_symlink()
