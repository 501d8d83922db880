"""What a run calls its own, and who may write at all."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest

from flashdex.errors import RunError
from flashdex.system.files import open_own, open_plain, read_own, remove_own
from flashdex.system.jsonl import append_line, read_lines, read_object, write_object
from flashdex.system.run_files import (
    METRICS,
    REPLAY,
    check_run,
    read_metrics,
    refuse_old_run,
    remove_temporaries,
)

PACKAGE = Path(__file__).parents[2] / "flashdex"
# calls that write, delete or rename by a path, links included
RAW = {
    "open to write",
    "unlink",
    "write_text",
    "write_bytes",
    "rmtree",
    "rename",
    "touch",
    "rglob",
}
# the one mechanism; and folders that are made for the purpose, or chosen by the user
ALLOWED = {
    "system/files.py",
    "system/run_files.py",
    "system/machine.py",  # adds up what a folder holds
    "motions/library_writer.py",
    "motions/library_meshes.py",
    "motions/library_check.py",
    "system/arrays.py",  # of a library that is being made
    "motions/pipeline/cache.py",
    "recipe/merge.py",
    "recipe/store.py",  # a copy under a name of the user's
    "cli/data.py",
    "training/run_dir.py",  # a recipe in a folder of its own, to be read
    "reports/render/rollout.py",  # a film that is not finished
}


def raw_calls(path):
    """Names of the methods that a file calls; of ``open``, with a mode that writes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for call in [node for node in ast.walk(tree) if isinstance(node, ast.Call)]:
        name = getattr(call.func, "attr", getattr(call.func, "id", ""))
        words = [*call.args, *(k.value for k in call.keywords)]
        modes = [w.value for w in words if isinstance(w, ast.Constant)]
        if name == "open" and {"w", "x", "a", "wb", "xb", "ab"} & set(map(str, modes)):
            yield "open to write"
        yield name


def test_files_are_written_and_deleted_by_one_mechanism():
    found = {
        str(path.relative_to(PACKAGE)): sorted(RAW & set(raw_calls(path)))
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "datasets")  # other folders than a run
    }
    odd = {name: calls for name, calls in found.items() if calls}
    assert set(odd) <= ALLOWED, {k: v for k, v in odd.items() if k not in ALLOWED}


def test_only_known_half_written_files_are_removed(tmp_path):
    (tmp_path / REPLAY).mkdir(parents=True)
    (tmp_path / "mine").mkdir()
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    outside.write_text("precious")
    half = [f"{REPLAY}/.000000000001-0.pt.7.tmp", ".metrics.csv.12.tmp"]
    kept = [".vimrc.tmp", ".notes.7.tmp", "mine/.metrics.csv.12.tmp", "a.7.tmp"]
    for name in [*half, *kept]:
        (tmp_path / name).write_text("x")
    (tmp_path / ".recipe.yaml.7.tmp").symlink_to(outside)
    remove_temporaries(tmp_path)
    assert not any((tmp_path / name).exists() for name in half)
    assert all((tmp_path / name).exists() for name in kept)
    assert outside.read_text() == "precious"


def test_what_a_run_does_not_know_may_lie_in_its_folder(tmp_path):
    (tmp_path / "notes").symlink_to(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    os.mkfifo(tmp_path / "checkpoints" / "pipe")
    check_run(tmp_path)


def test_a_hard_link_keeps_what_it_had(tmp_path):
    one, two = tmp_path / "one.jsonl", tmp_path / "two.jsonl"
    append_line(one, {"a": 1})
    two.hardlink_to(one)
    before = two.read_bytes()
    append_line(one, {"a": 2})
    assert two.read_bytes() == before
    assert read_lines(one) == [{"a": 1}, {"a": 2}]
    with open_plain(two, "r+b") as file:
        file.truncate(0)
    assert len(read_lines(one)) == 2


def test_nothing_is_written_where_the_folder_is_gone(tmp_path):
    with pytest.raises(OSError, match="gone"), open_own(tmp_path / "no", "a.json"):
        pass
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("parts", [("../a",), ("a", "../../b"), ("/etc/passwd",), ()])
def test_no_part_leads_out_of_the_folder(tmp_path, parts):
    for call in (remove_own, read_own, read_object):
        with pytest.raises(RunError):
            call(tmp_path, *parts)


def test_an_object_comes_back_and_a_changed_one_does_not(tmp_path):
    content = {"motions": {"é": "1"}, "x": [1, 2.5, None]}
    write_object(content, tmp_path, "a.json")
    assert read_object(tmp_path, "a.json") == content
    text = (tmp_path / "a.json").read_text()
    for old, new in (("2.5", "2.6"), ('"sha256"', '"sha257"'), ("\n}", "\n}")):
        (tmp_path / "a.json").write_text(text.replace(old, new))
        if old != new:
            with pytest.raises(RunError, match="was changed or damaged"):
                read_object(tmp_path, "a.json")
    assert read_object(tmp_path, "missing.json") == {}


@pytest.mark.parametrize(
    "line",
    [
        {"env_steps": 1.0},
        {"env_steps": "1", "hours": 0.0},
        {"env_steps": 1.0, "hours": float("nan")},
        {"env_steps": 1.0, "hours": 0.0, "loss": "0.1"},
        {"env_steps": 1.0, "hours": 0.0, "loss": True},
        {"env_steps": 1.0, "hours": 0.0, "loss": float("inf")},
    ],
    ids=str,
)
def test_a_record_is_finite_numbers(tmp_path, line):
    append_line(tmp_path / METRICS, line)
    with pytest.raises(RunError, match="line 1"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("name", ["file", "file/run", "file/a/run", "link"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(name, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(RunError, match="cannot be written"):
        refuse_old_run(tmp_path / name)
    refuse_old_run(tmp_path / "new" / "run")
    assert not (tmp_path / "new").exists()
