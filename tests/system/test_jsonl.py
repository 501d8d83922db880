"""Sealed lines: a crash costs the last one, a change is found, nothing is guessed."""

import errno
import hashlib
import json
import os

import pytest

from flashdex.errors import RunError
from flashdex.system import jsonl
from flashdex.system.jsonl import (
    append_line,
    drop_cut_line,
    keep_lines,
    parse_json,
    read_lines,
)

LINES = [{"n": i, "name": "\u00e4", "x": i / 7} for i in range(5)]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.jsonl"
    for line in LINES:
        append_line(path, line)
    return path


def test_lines_come_back_and_are_json_with_the_hash_of_what_is_before(file):
    assert read_lines(file) == LINES
    before = ""
    for line in file.read_text().splitlines():
        found = json.loads(line)
        body = json.dumps({k: v for k, v in found.items() if k != "sha256"})
        before = hashlib.sha256((before + body).encode()).hexdigest()
        assert found["sha256"] == before


def edit(lines):
    return [lines[0], lines[1].replace(b'"n": 1', b'"n": 7'), *lines[2:]]


CHANGES = {
    "edited": edit,
    "removed": lambda x: [x[0], *x[2:]],
    "first removed": lambda x: x[1:],
    "doubled": lambda x: [*x[:2], *x[1:]],
    "swapped": lambda x: [x[0], x[2], x[1], *x[3:]],
    "inserted": lambda x: [x[0], b'{"n": 1, "name": "", "x": 0.5}', *x[1:]],
    "added without seal": lambda x: [*x, b'{"n": 1, "name": "", "x": 0.5}'],
    "seal removed": lambda x: [*x[:-1], x[-1].split(b', "sha')[0] + b"}"],
    "blank": lambda x: [*x[:2], b"", *x[2:]],
    "garbage": lambda x: [*x[:2], b"\x80\x81", *x[2:]],
    "list": lambda x: [b"[1, 2]", *x],
    "number": lambda x: [b"7", *x],
    "latin-1": lambda x: [b'{"n": 1, "name": "\xe4", "x": 0.5}', *x],
    "byte order mark": lambda x: [b"\xef\xbb\xbf" + x[0], *x[1:]],
    "deep": lambda x: [b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}", *x],
    "zeros inside": lambda x: [*x[:2], bytes(40), *x[2:]],
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_changed_line_is_named(file, change):
    lines = change(file.read_bytes().splitlines())
    file.write_bytes(b"".join(line + b"\n" for line in lines))
    with pytest.raises(RunError, match=r"a\.jsonl: line \d+ .*restore"):
        read_lines(file)


def test_every_cut_is_a_shorter_file_or_a_torn_line(file):
    """A crash cuts anywhere: what is whole is read, and the next line joins nothing."""
    content = file.read_bytes()
    ends = [i for i, byte in enumerate(content) if byte == 10]
    for size in range(0, len(content), 11):
        file.write_bytes(content[:size])
        whole = sum(end < size for end in ends)
        assert read_lines(file) == LINES[:whole]
        drop_cut_line(file)
        append_line(file, {"n": 9})
        assert read_lines(file) == [*LINES[:whole], {"n": 9}]


@pytest.mark.parametrize("tail", [b"\0" * 512, b'{"n": 1' + b"\0" * 99, b"\xff\xfe"])
def test_a_tail_that_a_crash_leaves_is_dropped_and_told(file, caplog, tail):
    with file.open("ab") as stream:
        stream.write(tail)
    assert read_lines(file) == LINES
    drop_cut_line(file)
    assert f"{len(tail)} bytes are removed" in caplog.text
    append_line(file, {"n": 9})
    assert read_lines(file)[-1] == {"n": 9}


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ({"name": "a", "x": 1.0}, "lacks 'n'"),
        ({"n": "1", "name": "a", "x": 1.0}, "has '1' as 'n'"),
        ({"n": 1.5, "name": "a", "x": 1.0}, "has 1.5 as 'n'"),
        ({"n": True, "name": "a", "x": 1.0}, "has True as 'n'"),
        ({"n": 1, "name": None, "x": 1.0}, "has None as 'name'"),
        ({"n": 1, "name": "a", "x": "nan"}, "has 'nan' as 'x'"),
    ],
)
def test_a_line_without_what_its_reader_needs_is_named(file, line, fault):
    schema = {"n": int, "name": str, "x": float}
    assert read_lines(file, schema) == LINES
    append_line(file, line)
    with pytest.raises(RunError, match=f"line 6 {fault}"):
        read_lines(file, schema)


def test_lines_that_are_kept_are_sealed_anew(file):
    keep_lines(file, lambda line: line["n"] != 2)
    append_line(file, {"n": 9})
    assert [line["n"] for line in read_lines(file)] == [0, 1, 3, 4, 9]


def test_a_full_disk_leaves_whole_lines(file, monkeypatch):
    content = file.read_bytes()

    def refuse(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(jsonl.os, "fsync", refuse)
    with pytest.raises(OSError, match="No space"):
        append_line(file, {"n": 5})
    assert file.read_bytes() == content


def test_a_hole_on_the_disk_is_not_read(file):
    os.truncate(file, 1 << 40)
    with pytest.raises(RunError, match="larger than 512 MiB"):
        read_lines(file)


@pytest.mark.parametrize("text", ["[" + "[]," * 999 + "0]", "[" + "0," * 999 + "{}]"])
def test_values_are_counted_before_they_are_built(file, tmp_path, monkeypatch, text):
    monkeypatch.setattr(jsonl, "MAX_VALUES", 900)
    monkeypatch.setattr(jsonl.json, "loads", None)
    with pytest.raises(ValueError, match="more than 900 values"):
        parse_json(text.encode())
    with file.open("a") as stream:
        stream.write(f'{{"a": {text}}}\n')
    with pytest.raises(RunError, match="more than 900 values"):
        read_lines(file)


@pytest.mark.parametrize("kind", ["link", "dangling", "pipe", "folder"])
def test_nothing_else_is_read_or_written_in_its_place(tmp_path, kind):
    path, other = tmp_path / "a.jsonl", tmp_path / "other"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(other)
        if kind == "link":
            other.write_text("keep")
    with pytest.raises(OSError, match=r"."):
        append_line(path, {"n": 1})
    with pytest.raises(RunError, match="cannot be read"):
        read_lines(path)
    assert not other.exists() or other.read_text() == "keep"
