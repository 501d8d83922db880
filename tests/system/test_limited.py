"""Work in a child process: its value comes back, and whatever ends it is told."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flashdex.system.limited import LimitError, run_limited
from flashdex.system.names import file_stem

LIMITS = {"memory": 1 << 30, "seconds": 2}


def test_value_comes_back():
    assert run_limited(math.gcd, 12, 18, **LIMITS) == 6


@pytest.mark.parametrize(
    ("function", "args", "told"),
    [
        pytest.param(math.factorial, (10**8,), "more than 2 s", id="cpu_time"),
        pytest.param(bytes, (8 << 30,), "more than 1.0 GiB", id="memory"),
        pytest.param(os.abort, (), "ended the process", id="crash"),
        pytest.param(os._exit, (0,), "ended the process", id="silent_end"),
        pytest.param(json.loads, ("{",), "JSONDecodeError", id="exception"),
    ],
)
def test_what_ends_it_is_told(function, args, told):
    with pytest.raises(LimitError, match=told):
        run_limited(function, *args, **LIMITS)


def test_sleeping_counts_as_time(monkeypatch):
    monkeypatch.setattr("flashdex.system.limited.GRACE", 0.0)
    monkeypatch.setattr("flashdex.system.limited.WALL", 1.0)
    start = time.monotonic()
    with pytest.raises(LimitError, match="more than 1 s"):
        run_limited(time.sleep, 60, memory=1 << 30, seconds=1)
    assert time.monotonic() - start < 10


def test_what_it_starts_imports_nothing_from_where_it_is():
    text = "1 if os.environ.get('PYTHONSAFEPATH') else 0"
    words = [sys.executable, "-c", f"import os; raise SystemExit({text})"]
    assert run_limited(subprocess.call, words, **LIMITS) == 1


def test_it_writes_no_file(tmp_path):
    with pytest.raises(LimitError):
        run_limited(os.truncate, str(tmp_path / "new"), 10, **LIMITS)
    (tmp_path / "file").touch()
    with pytest.raises(LimitError):
        run_limited(os.truncate, str(tmp_path / "file"), 10, **LIMITS)
    assert (tmp_path / "file").stat().st_size == 0


def test_an_editable_install_is_found_from_any_folder(monkeypatch, tmp_path):
    """It is imported by a hook of site-packages, and stands on no path."""
    root = Path(__file__).parents[2]
    path = [p for p in sys.path if p and Path(p).resolve() != root]
    monkeypatch.setattr(sys, "path", path)
    monkeypatch.chdir(tmp_path)
    limits = {"memory": 1 << 30, "seconds": 10}
    assert run_limited(file_stem, "a b", **limits) == file_stem("a b")
