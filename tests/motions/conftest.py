"""A library of one's own to damage."""

import shutil

import pytest


@pytest.fixture
def copy(library, tmp_path, monkeypatch):
    """A copy of the synthetic library, and a cache of its own."""
    monkeypatch.setenv("FLASHDEX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = tmp_path / "lib"
    shutil.copytree(library.path, path)
    return path
