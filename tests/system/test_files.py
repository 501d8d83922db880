"""Atomic writes: the whole new file or the old one, and nothing beside it."""

import os

import pytest

from flashdex.system.files import open_atomic, write_atomic


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
