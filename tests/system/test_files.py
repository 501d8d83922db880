"""Atomic writes: the whole new file or the old one, and nothing beside it."""

import os
import subprocess
import sys

import pytest

from flashdex.errors import RunError
from flashdex.system.files import open_atomic, run_lock, waiting_lock, write_atomic

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


def test_a_folder_that_cannot_be_made_is_worked_in_without_a_lock(tmp_path):
    (tmp_path / "file").write_text("")
    with waiting_lock(tmp_path / "file" / "asset"):
        pass
