"""Archives from outside: bounded before they are unpacked, checked, never unpickled."""

import errno
import io
import os
import pickle
import struct
import zipfile
import zlib

import numpy as np
import pytest

from flashdex.system import archives
from flashdex.system.archives import check_archive, read_array, read_npz


def npy(array, **kwargs):
    file = io.BytesIO()
    np.save(file, array, **kwargs)
    return file.getvalue()


def write_zip(path, members, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_numpy_wrote_them(tmp_path, save):
    arrays = {
        "f": np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4))),
        "i": np.arange(5),
        "t": np.array("t\u00ebxt"),
        "n": np.zeros((0, 3), np.float32),
        "b": np.array([True, False]),
    }
    save(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz")
    assert set(found) == set(arrays)
    for key, array in arrays.items():
        assert found[key].dtype == array.dtype
        np.testing.assert_array_equal(found[key], array)


def test_every_flipped_bit_of_the_content_is_found(tmp_path):
    path = tmp_path / "a.npz"
    values = np.random.default_rng(0).normal(size=100)
    np.savez(path, values=values)
    content = path.read_bytes()
    start = content.index(values.tobytes())
    for offset in range(start, start + values.nbytes, 7):
        broken = bytearray(content)
        broken[offset] ^= 1 << offset % 8
        path.write_bytes(broken)
        with pytest.raises(ValueError, match="not a whole archive"):
            read_npz(path)
        with pytest.raises(ValueError, match="checksum differs"):
            check_archive(path)


MACHINE = (MemoryError(), OSError(errno.EIO, "failed"), zlib.error("Error -4 while"))


@pytest.mark.parametrize("failure", MACHINE, ids=lambda f: type(f).__name__)
@pytest.mark.parametrize("read", [check_archive, read_npz])
def test_a_machine_that_fails_is_no_damage(tmp_path, monkeypatch, read, failure):
    def fail(*_):
        raise failure

    np.savez_compressed(tmp_path / "a.npz", values=np.arange(5))
    monkeypatch.setattr(zipfile.ZipExtFile, "read", fail)
    with pytest.raises(type(failure)):
        read(tmp_path / "a.npz")


class Harm:
    def __reduce__(self):
        return os.mkdir, ("harmed",)


REFUSED = {
    "object array": {"a.npy": npy(np.array([Harm()], dtype=object), allow_pickle=True)},
    "a pickle": {"a.npy": pickle.dumps(Harm())},
    "records": {"a.npy": npy(np.zeros(3, dtype=[("x", "f4")]))},
    "other files": {"a.npy": npy(np.zeros(3)), "b.txt": b""},
    "nothing": {},
    "terabytes": {"a.npy": npy(np.zeros(1)).replace(b"(1,), }", b"(1,) }")},
    "cut": {"a.npy": npy(np.zeros(9))[:-8]},
    "more": {"a.npy": npy(np.zeros(9)) + b"12345678"},
}
REFUSED["terabytes"] = {
    "a.npy": npy(np.zeros(1)).replace(b"(1,), }            ", b"(1099511627776,), }")
}
BOMB = {"a.npy": npy(np.zeros(80 << 20, np.uint8))}


@pytest.mark.parametrize("members", REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_plain_array_is_refused_and_nothing_runs(
    tmp_path, monkeypatch, members
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"."):
        read_npz(write_zip(tmp_path / "a.npz", members))
    assert os.listdir(tmp_path) == ["a.npz"]


def test_bombs_are_refused_by_what_they_declare(tmp_path):
    path = write_zip(tmp_path / "a.npz", BOMB)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ValueError, match="80 MiB"):
        read_npz(path)  # by its ratio
    plain = write_zip(tmp_path / "b.npz", {"a.npy": npy(np.zeros(99999))}, 0)
    with pytest.raises(ValueError, match="0 are allowed"):
        read_npz(plain, limit=1 << 19)


@pytest.mark.parametrize("newer", [False, True], ids=["old_record", "newer_record"])
@pytest.mark.parametrize("before", [b"", b"PK\5\6" + bytes(9)], ids=["", "overlapped"])
def test_a_list_of_members_without_end_is_not_read(
    tmp_path, newer, before, monkeypatch
):
    monkeypatch.setattr(archives.zipfile, "ZipFile", None)
    size = archives.MAX_DIRECTORY + 1
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, size, 0, 0)
    if newer:
        count = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 9, 9, size, 0)
        end = end.replace(struct.pack("<L", size), b"\xff" * 4)
        end = count + struct.pack("<4sLQL", b"PK\6\7", 0, 0, 1) + end
    (tmp_path / "a.npz").write_bytes(before + end)
    for read in (read_npz, check_archive):
        with pytest.raises(ValueError, match="list of files is larger than 32 MiB"):
            read(tmp_path / "a.npz")


def test_a_member_that_lies_about_its_size_is_refused(tmp_path):
    path = write_zip(tmp_path / "a.npz", {"a.npy": npy(np.zeros(50_000))})
    content = path.read_bytes()
    size = len(npy(np.zeros(50_000))).to_bytes(4, "little")
    assert content.count(size) == 2
    path.write_bytes(content.replace(size, (1000).to_bytes(4, "little")))
    with pytest.raises(ValueError, match="not a whole archive"):
        read_npz(path)


def test_bytes_of_a_header_are_bounded():
    size = (50_000).to_bytes(4, "little")
    with pytest.raises(ValueError, match=r"."):
        read_array(io.BytesIO(b"\x93NUMPY\x02\x00" + size + b" " * 50_000), 50_012)
