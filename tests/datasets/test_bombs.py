"""Small files that become large ones, or are none: refused before anything grows."""

import io
import json
import os
import pickle
import re
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch

from flashdex.datasets.fields import numbers
from flashdex.datasets.files import (
    load_npy,
    load_npz,
    load_pickle,
    load_torch,
    read_bytes,
    read_json,
    read_text,
)
from flashdex.errors import DemoError
from flashdex.system import pickled
from flashdex.system.tensors import read_tensors, write_tensors

LOADERS = {
    "pickle": load_pickle,
    "npy": load_npy,
    "npz": load_npz,
    "torch": load_torch,
    "json": lambda path: read_json(path, "not JSON"),
    "text": read_text,
    "bytes": read_bytes,
}
loaders = pytest.mark.parametrize("load", LOADERS.values(), ids=LOADERS)
# an entry of the list at the end of an archive, up to its flags
ENTRY = re.compile(rb"(PK\x01\x02.{4})\0\0", re.DOTALL)


@pytest.fixture(autouse=True)
def no_growth():
    """No test here may take more than a tenth of what its file pretends to be."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400e6


def npy_head(shape, dtype="<f8"):
    head = io.BytesIO()
    facts = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_2_0(head, facts)
    return head.getvalue()


def zipped(path, entries, *, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return path


def inflated(path, size, *, kind=zipfile.ZIP_DEFLATED, parts=1):
    """An archive of zeros, written a piece at a time; its sizes are true."""
    head = npy_head((size // 8,))
    with zipfile.ZipFile(path, "w", kind, allowZip64=True) as archive:
        for part in range(parts):
            with archive.open(f"a{part}.npy", "w", force_zip64=True) as file:
                file.write(head)
                for _ in range(size >> 20):
                    file.write(bytes(1 << 20))
    return path


@loaders
def test_terabyte_that_is_a_hole_is_not_read(tmp_path, load):
    with (tmp_path / "file").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DemoError, match=r"1048576 MiB; at most \d+ MiB are read"):
        load(tmp_path / "file")


@loaders
@pytest.mark.parametrize("kind", ["pipe", "device", "link_to_device", "folder"])
def test_what_is_no_file_is_not_waited_for(tmp_path, load, kind):
    path = tmp_path / "file"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    target = path.readlink() if kind == "device" else path
    with pytest.raises(DemoError, match="not a file but a folder, a pipe, a device"):
        load(target)


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        pytest.param(zipfile.ZIP_DEFLATED, 1, id="deflate"),
        pytest.param(zipfile.ZIP_BZIP2, 1, id="bzip2"),
        pytest.param(zipfile.ZIP_LZMA, 1, id="lzma"),
        pytest.param(zipfile.ZIP_DEFLATED, 8, id="many_small_ones"),
    ],
)
@pytest.mark.parametrize("load", [load_npz, load_torch])
def test_archive_of_zeros_is_refused_by_its_ratio(tmp_path, load, kind, parts):
    path = inflated(tmp_path / "a", (80 << 20) // parts, kind=kind, parts=parts)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(DemoError, match=r"unpacks to 80 MiB, \d+ times"):
        load(path)


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        pytest.param((10**13,), "<f8", id="terabytes"),
        pytest.param((2**31, 2**31, 2**31), "<f8", id="overflow"),
        pytest.param((-1,), "<f8", id="negative"),
        pytest.param((10**9,), "<U1000000", id="long_texts"),
        pytest.param((1,) * 40, "<f8", id="too_many_axes"),
        pytest.param((2**62,), "|V0", id="nothing_often"),
        pytest.param((2**40,), "|S0", id="empty_texts"),
    ],
)
def test_announced_shapes_are_not_allocated(tmp_path, shape, dtype):
    data = npy_head(shape, dtype) + bytes(64)
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(DemoError, match="not a readable"):
        load_npy(tmp_path / "a.npy")
    for plain in (False, True):
        with pytest.raises(DemoError, match="not a readable"):
            load_npz(zipped(tmp_path / "a.npz", {"a.npy": data}), plain=plain)


def test_header_too_deep_for_the_parser_is_one_message(tmp_path):
    text = b"{'descr':'<f8','fortran_order':False,'shape':(" + b"-" * 9000 + b"1,)}\n"
    head = b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text
    (tmp_path / "a.npy").write_bytes(head)
    with pytest.raises(DemoError, match="nested too deep"):
        load_npy(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda d: d[:-30], id="cut"),
        pytest.param(lambda d: d.replace(b"PK\1\2", b"PK\1\3"), id="directory"),
        pytest.param(lambda d: d[:60] + bytes([d[60] ^ 1]) + d[61:], id="flipped_bit"),
        pytest.param(lambda d: ENTRY.sub(b"\\g<1>\1\0", d), id="encrypted"),
        pytest.param(lambda d: d.replace(b"\x08\0", b"\x63\0"), id="unknown_method"),
    ],
)
def test_unsound_archive_is_one_message(tmp_path, damage):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(50), b=np.arange(3))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DemoError, match=r"a\.npz: not a readable"):
        load_npz(path)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("[" * 10**6, id="deep"),
        pytest.param('{"a":' * 10**5, id="deep_objects"),
        pytest.param("9" * 10**6, id="long_number"),
        pytest.param('{"a": 1' + "0" * 10**5 + "}", id="long_number_inside"),
        pytest.param("\ud800".encode("utf-8", "surrogatepass"), id="surrogates"),
        pytest.param(b"\xff\xfe{\0}\0", id="utf16"),
        pytest.param(b"\0" * 1000, id="nul"),
        pytest.param("", id="empty"),
    ],
)
def test_json_bombs_are_one_message(tmp_path, text):
    data = text if isinstance(text, bytes) else text.encode()
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(DemoError, match=r"a\.json: not JSON"):
        read_json(tmp_path / "a.json", "not JSON")


def laughs(levels, make):
    item = make([0] * 10)
    for _ in range(levels):
        item = make([item] * 10)
    return item


def nested_keys(levels):
    """A dictionary whose key is a tuple of two of the tuple below it, and so on."""
    pair = "h{0}h{0}\x86q{1}0"  # twice from the memo, a tuple, to the memo, gone
    tuples = [pair.format(chr(i), chr(i + 1)) for i in range(levels)]
    text = "\x80\x02})q\x000" + "".join(tuples) + "h" + chr(levels) + "Ns."
    return text.encode("latin-1")


@pytest.mark.parametrize("levels", [5, 60])
def test_pickle_of_keys_that_never_end(tmp_path, levels):
    path = tmp_path / "a.pkl"
    path.write_bytes(nested_keys(levels))
    if levels < 10:
        assert load_pickle(path) == pickle.loads(nested_keys(levels))
        return
    with pytest.raises(DemoError, match="keys that would take hours"):
        load_pickle(path)


@pytest.mark.parametrize("is_old", [False, True], ids=["archive", "old_layout"])
def test_torch_file_of_keys_that_never_end(tmp_path, is_old):
    path = tmp_path / "a.pt"
    torch.save({}, path, _use_new_zipfile_serialization=not is_old)
    content = path.read_bytes()
    if is_old:
        empty = pickle.dumps({}, 2)
        assert content.count(empty) == 1
        path.write_bytes(content.replace(empty, nested_keys(60)))
    else:
        zipped(path, {"a/data.pkl": nested_keys(60), "a/version": "3\n"})
    with pytest.raises(DemoError, match="keys that would take hours"):
        load_torch(path)
    if not is_old:
        with pytest.raises(ValueError, match="keys that would take hours"):
            read_tensors(tmp_path, "a.pt")


@pytest.mark.parametrize("levels", [9, 40])
def test_tensors_in_lists_of_the_same_lists_are_not_walked(tmp_path, levels):
    write_tensors({"a": laughs(levels, list)}, tmp_path, "a.pt")
    with pytest.raises(ValueError, match="more than 1000000 parts"):
        read_tensors(tmp_path, "a.pt")


def test_a_view_in_a_file_of_a_run_is_not_made_true(tmp_path):
    write_tensors({"a": torch.ones(1).expand(1 << 10, 1 << 15)}, tmp_path, "a.pt")
    with pytest.raises(ValueError, match="its tensors claim 128 MiB"):
        read_tensors(tmp_path, "a.pt")


@pytest.mark.parametrize(
    "odd",
    [
        pytest.param(torch.empty(9, device="meta"), id="meta"),
        pytest.param(torch.eye(3).to_sparse(), id="sparse"),
        pytest.param(torch.ones(3).to(torch.float8_e4m3fn), id="without_arithmetic"),
        pytest.param([[[]]] * 9 + [laughs(0, lambda x: x)], id="plain"),
    ],
)
def test_tensors_that_hold_no_numbers_of_their_own_are_refused(tmp_path, odd):
    write_tensors({"a": odd}, tmp_path, "a.pt")
    if isinstance(odd, list):
        assert read_tensors(tmp_path, "a.pt") == {"a": odd}
        return
    with pytest.raises(ValueError, match="not plain"):
        read_tensors(tmp_path, "a.pt")


def test_pickle_of_one_large_key_many_times(tmp_path):
    path, size = tmp_path / "a.pkl", 30_000
    key = b"(" + b"K\x01" * size + b"tq\x00"
    path.write_bytes(b"\x80\x02}" + key + b"N" + b"s(" + b"h\x00N" * size + b"u.")
    with pytest.raises(DemoError, match="keys that would take hours"):
        load_pickle(path)


def test_pickle_of_endless_steps_is_one_message(tmp_path, monkeypatch):
    monkeypatch.setattr(pickled, "MAX_STEPS", 1000)
    path = tmp_path / "a.pkl"
    path.write_bytes(b"N0" * 2000 + b"N.")
    with pytest.raises(DemoError, match="more than 1,000 steps"):
        load_pickle(path)


@pytest.mark.parametrize(
    "bomb",
    [
        pytest.param(laughs(9, list), id="lists"),
        pytest.param(laughs(9, tuple), id="tuples"),
        pytest.param(laughs(9, lambda x: dict(enumerate(x))), id="tables"),
        pytest.param([bytes(10**6)] * 10**5, id="long_parts_are_shared"),
    ],
)
def test_pickle_of_the_same_parts_does_not_grow(tmp_path, bomb):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(bomb))
    if isinstance(bomb, list) and isinstance(bomb[0], bytes):
        assert load_pickle(path)[99_999] == bytes(10**6)
        return
    with pytest.raises(DemoError, match="more than 50000000 parts"):
        load_pickle(path)


@pytest.mark.parametrize(
    "ops",
    [
        pytest.param(b"(" * 10**6 + b".", id="marks"),
        pytest.param(b"\x80\x04" + b"]\x94" * 10**4 + b"a" * 9_999 + b".", id="deep"),
        pytest.param(b"I" + b"9" * 10**6 + b"\n.", id="long_number"),
        pytest.param(b"L" + b"9" * 10**6 + b"L\n.", id="long_old_number"),
        pytest.param(b"\x80\x04\x8b\xff\xff\xff\x7f1.", id="long_length"),
        pytest.param(b"\x80\x04\x8b\xff\xff\xff\xff1.", id="negative_length"),
        pytest.param(b"\x80\x04\x95" + b"\xff" * 8 + b".", id="frame"),
        pytest.param(
            pickle.dumps({i * (2**61 - 1): 0 for i in range(99)}), id="one_hash"
        ),
        pytest.param(b"\x80\xff.", id="protocol"),
        pytest.param(b"0" * 10**6, id="pops"),
        pytest.param(b"g999\n.", id="memo_that_is_not_there"),
        pytest.param(b"S'" + b"\\x41" * 10 + b"\n.", id="open_quote"),
    ],
)
def test_pickles_of_odd_steps_are_one_message(tmp_path, ops):
    path = tmp_path / "a.pkl"
    path.write_bytes(ops)
    with pytest.raises(DemoError, match=r"a\.pkl: not a readable pickle"):
        load_pickle(path)


@pytest.mark.parametrize(
    "many",
    [
        pytest.param(np.broadcast_to(np.float64(1), (10**6, 10**6)), id="array"),
        pytest.param(torch.ones(1).expand(10**6, 10**6), id="tensor"),
    ],
)
def test_views_that_say_they_are_many_are_not_copied(many):
    with pytest.raises(DemoError, match="1000000000000 numbers"):
        numbers(many, what="file: key")


def test_torch_file_of_a_view_does_not_grow(tmp_path):
    path = tmp_path / "a.pt"
    torch.save({"a": torch.ones(1).expand(10**6, 10**6)}, path)
    assert path.stat().st_size < 10**4
    with pytest.raises(DemoError, match="1000000000000 numbers"):
        numbers(load_torch(path)["a"], what="file: a")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_shared_names_are_not_read_twice(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for value in (1, 2):
            file = io.BytesIO()
            np.save(file, np.array(value))
            archive.writestr("a.npy", file.getvalue())
    assert load_npz(path) == {"a": 2}


def test_large_json_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("flashdex.datasets.files.MAX_TEXT", 1 << 20)
    (tmp_path / "a.json").write_text(json.dumps(["x" * (1 << 20)]))
    with pytest.raises(DemoError, match="1 MiB; at most 1 MiB are read"):
        read_json(tmp_path / "a.json", "not JSON")
