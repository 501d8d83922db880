"""What is free: the kernel's table, limits of containers, the disk."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from flashdex.system import machine
from flashdex.system.machine import free_host, look_at_machine

GB = 10**9


@pytest.fixture
def meminfo(tmp_path):
    file = tmp_path / "meminfo"
    file.write_text(
        "MemTotal:  64000000 kB\nMemFree: 1 kB\nMemAvailable: 50000000 kB\n"
    )
    return file


def write_group(folder, limit, used, cached):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cgroup.controllers").write_text("memory\n")
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cached}\nslab 3\n")


def test_without_a_limit_the_kernel_is_right(meminfo, tmp_path):
    assert free_host(meminfo, tmp_path / "none") == 50_000_000 * 1024
    write_group(tmp_path / "group", "max", GB, 0)
    assert free_host(meminfo, tmp_path / "group") == 50_000_000 * 1024


def test_a_container_may_have_less(meminfo, tmp_path):
    write_group(tmp_path / "group", 16 * GB, 10 * GB, 3 * GB)
    assert free_host(meminfo, tmp_path / "group") == 9 * GB


def test_a_group_above_may_be_smaller(meminfo, tmp_path):
    write_group(tmp_path / "outer", 8 * GB, 7 * GB, 0)
    write_group(tmp_path / "outer" / "inner", 16 * GB, GB, 0)
    assert free_host(meminfo, tmp_path / "outer" / "inner") == GB


def test_a_full_container_has_nothing(meminfo, tmp_path):
    write_group(tmp_path / "group", GB, 2 * GB, 0)
    assert free_host(meminfo, tmp_path / "group") == 0


def test_unreadable_limits_count_as_none(meminfo, tmp_path):
    write_group(tmp_path / "group", "what", 0, 0)
    assert free_host(meminfo, tmp_path / "group") == 50_000_000 * 1024


def test_without_a_table_the_installed_memory_counts(tmp_path):
    found = free_host(tmp_path / "none", tmp_path)
    assert found is not None
    assert found > 0


def test_a_run_directory_need_not_exist(tmp_path):
    machine = look_at_machine(tmp_path / "runs" / "not" / "yet")
    assert machine.disk == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.05)
    assert machine.host is not None
    assert machine.free("host") == machine.host


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A git checkout with one changed file, taken for flashdex's own."""
    words = ["-c", "user.name=a", "-c", "user.email=a@b.c"]

    def git(*more):
        subprocess.run(["git", "-C", str(tmp_path), *words, *more], check=True)

    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "code.py").write_text("one\n")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "one")
    (tmp_path / "code.py").write_text("two\n")
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "a" / "b" / "machine.py"))
    return tmp_path, git


def test_changes_are_kept_and_no_command_of_the_repository_runs(checkout):
    folder, git = checkout
    trap = folder / "trap.sh"
    trap.write_text(f"#!/bin/sh\ntouch {folder}/sprung\n")
    trap.chmod(0o755)
    (folder / ".git/info/attributes").write_text("*.py diff=evil\n")
    for key in ("diff.external", "diff.evil.textconv", "core.fsmonitor"):
        git("config", key, str(trap))
    assert b"+two" in machine.source_changes()
    assert not (folder / "sprung").exists()


@pytest.mark.parametrize(
    "content", [b"\0\xff" * 50, b"\xe9\n" * 50], ids=["binary", "latin-1"]
)
def test_changes_of_any_content_end_nothing(checkout, content):
    (checkout[0] / "code.py").write_bytes(content)
    assert machine.source_changes()


def test_long_changes_are_cut_off(checkout, monkeypatch):
    monkeypatch.setattr(machine, "DIFF_BYTES", 1000)
    (checkout[0] / "code.py").write_text("line\n" * 1000)
    found = machine.source_changes()
    assert len(found) < 1100
    assert found.endswith(b"(cut off)\n")


@pytest.mark.parametrize(
    "fault", [FileNotFoundError, subprocess.TimeoutExpired("git", 10)]
)
def test_a_git_that_is_missing_or_slow_ends_nothing(checkout, monkeypatch, fault):
    def fail(*args, **options):
        raise fault

    monkeypatch.setattr(subprocess, "run", fail)
    assert machine.source_changes() == b""


def test_variables_for_git_name_no_other_repository(checkout, monkeypatch, tmp_path):
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "other"))
    monkeypatch.setenv("GIT_EXTERNAL_DIFF", "/bin/false")
    assert b"+two" in machine.source_changes()
