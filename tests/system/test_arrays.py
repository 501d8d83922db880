"""Arrays behind a manifest: mapped as announced, or refused; never changed."""

import os

import numpy as np
import pytest

from flashdex.errors import RunError
from flashdex.system.arrays import ArrayEntry, hash_content, map_array, write_array


@pytest.fixture
def stored(tmp_path):
    array = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    return tmp_path, array, write_array(tmp_path / "a.npy", array)


def test_an_array_comes_back_and_its_file_stays_as_it_is(stored):
    root, array, entry = stored
    assert ArrayEntry.parse(entry.to_dict()) == entry
    mapped = map_array(root, "a.npy", entry)
    np.testing.assert_array_equal(mapped, array)
    np.testing.assert_array_equal(np.load(root / "a.npy"), array)
    mapped[:] = 7.0  # in this process only
    assert hash_content(root / "a.npy") == entry.sha256
    empty = np.zeros((0, 3), np.float32)
    assert map_array(root, "b.npy", write_array(root / "b.npy", empty)).shape == (0, 3)


@pytest.mark.parametrize("step", [1 << 40, 1 << 28], ids=["whole", "sprinkled"])
def test_an_array_of_holes_is_not_read(tmp_path, step):
    entry = write_array(tmp_path / "a.npy", np.zeros(1000, np.uint8))
    big = ArrayEntry("uint8", (1 << 3, 1 << 30), entry.sha256)
    with (tmp_path / "a.npy").open("wb") as file:
        head = {"descr": "|u1", "fortran_order": False, "shape": big.shape}
        np.lib.format.write_array_header_1_0(file, head)
        start = file.tell()
        for place in range(start, start + big.num_bytes, step):
            file.seek(place)
            file.write(b"1")
        file.truncate(start + big.num_bytes)
    with pytest.raises(RunError, match="holes of more than 1024 MiB"):
        map_array(tmp_path, "a.npy", big)


def test_what_is_too_large_has_no_hash(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert hash_content(tmp_path / "a", most=5) == hash_content(tmp_path / "a") != ""
    os.truncate(tmp_path / "a", 1 << 40)
    assert hash_content(tmp_path / "a", most=5) == ""


def cut(path):
    path.write_bytes(path.read_bytes()[:-4])


def grow(path):
    path.write_bytes(path.read_bytes() + bytes(4))


def retype(path):
    np.save(path, np.load(path).view(np.int32))


def reshape(path):
    np.save(path, np.load(path).reshape(3, 6))


def transpose(path):
    np.save(path, np.asfortranarray(np.load(path)))


def empty(path):
    path.write_bytes(b"")


def link(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def folder(path):
    path.unlink()
    path.mkdir()


def remove(path):
    path.unlink()


FAULTS = (cut, grow, retype, reshape, transpose, empty, link, pipe, folder, remove)


@pytest.mark.parametrize("damage", FAULTS)
def test_a_file_that_is_not_what_was_announced_is_refused_as_it_is(stored, damage):
    root, _, entry = stored
    damage(root / "a.npy")
    size = (root / "a.npy").lstat().st_size if damage is not remove else None
    with pytest.raises(RunError, match=r"a\.npy"):
        map_array(root, "a.npy", entry)
    if size is not None:
        assert (root / "a.npy").lstat().st_size == size


ENTRIES = {
    "list": [1],
    "no shape": {"dtype": "float32", "sha256": ""},
    "objects": {"dtype": "object", "shape": [1], "sha256": ""},
    "class": {"dtype": {"_type": "os.system"}, "shape": [1], "sha256": ""},
    "negative": {"dtype": "float32", "shape": [-1], "sha256": ""},
    "truth": {"dtype": "float32", "shape": [True], "sha256": ""},
    "huge": {"dtype": "float32", "shape": [1 << 40, 1 << 40], "sha256": ""},
    "no list": {"dtype": "float32", "shape": "3", "sha256": ""},
    "no hash": {"dtype": "float32", "shape": [3], "sha256": None},
    "more": {"dtype": "float32", "shape": [3], "sha256": "", "x": 1},
}


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES.keys())
def test_an_entry_that_describes_no_array_is_refused(entry):
    with pytest.raises(ValueError, match=r"."):
        ArrayEntry.parse(entry)
