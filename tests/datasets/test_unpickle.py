"""Files with pickles: data come back exactly, everything else is refused."""

import builtins
import codecs
import collections
import io
import os
import pickle
import pickletools
import re
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from layouts.mano_files import mano_hand, write_mano

from flashdex.datasets import pickles
from flashdex.datasets.files import load_npy, load_npz, load_pickle, load_torch
from flashdex.datasets.pickles import MAGIC, STORAGES, VERSION
from flashdex.errors import DemoError

PROTOCOLS = range(6)


@pytest.fixture
def stored(tmp_path):
    """Write bytes, or a pickle of anything else, and give the file."""

    def write(content, *, protocol=2, name="file.pkl"):
        path = tmp_path / name
        raw = isinstance(content, bytes)
        path.write_bytes(content if raw else pickle.dumps(content, protocol))
        return path

    return write


class Call:
    """Pickles as a call of any function."""

    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


class Built(Call):
    """The same, given a state afterwards."""

    def __init__(self, call, state):
        super().__init__(call.function, *call.args)
        self.state = state

    def __reduce__(self):
        return self.function, self.args, self.state


def tree():
    """Everything that the datasets hold in containers."""
    ring = np.arange(24.0).reshape(2, 3, 4)
    return {
        "rot": ring,
        "columns": np.asfortranarray(ring),
        "foreign": ring.astype(">f4"),
        "flags": np.array([True, False]),
        "ids": np.array([3, -1], dtype=np.int16),
        "names": np.array(["a", "bcd"]),
        "empty": np.zeros((0, 3), np.float32),
        "single": np.array(2.5),
        "number": np.float32(0.1),
        "mixed": np.array([{"deep": np.arange(3)}, None], dtype=object),
        "plain": [1, 2.5, "text", b"\x00\xff", None, True, (1, {2}), frozenset([3])],
        "ordered": collections.OrderedDict([("z", 1), ("a", 2)]),
        np.int64(240): "a numpy key",
    }


def same(one, two):
    """Equal in type of content, order of keys and every value."""
    if isinstance(two, dict):
        pairs = zip(one.items(), two.items(), strict=True)
        return all(same(a, b) for x, y in pairs for a, b in zip(x, y, strict=True))
    if isinstance(two, np.ndarray) and two.dtype == object:
        return one.shape == two.shape and all(map(same, one.flat, two.flat))
    if isinstance(two, np.ndarray):
        kind = one.dtype == two.dtype.newbyteorder("=")
        return kind and one.shape == two.shape and np.array_equal(one, two)
    if isinstance(two, list):
        return all(same(a, b) for a, b in zip(one, two, strict=True))
    return type(one) is type(two) and one == two


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_data_come_back_exactly(stored, protocol):
    assert same(load_pickle(stored(tree(), protocol=protocol)), tree())


def test_arrays_can_be_written_to(stored):
    array = load_pickle(stored({"a": np.zeros(3)}))["a"]
    array[0] = 1.0
    assert type(array) is np.ndarray


@pytest.mark.parametrize("kind", ["csc", "csr", "coo"])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_sparse_matrices(stored, kind, protocol):
    dense = np.random.default_rng(0).standard_normal((5, 7)).round().clip(0)
    found = load_pickle(stored(sp.coo_matrix(dense).asformat(kind), protocol=protocol))
    assert found.format == kind
    assert np.array_equal(found.toarray(), dense)


@pytest.mark.parametrize("protocol", [2, 4])
def test_tensors_of_every_kind(stored, protocol):
    base = torch.arange(12.0).reshape(3, 4)
    tensors = {
        "view": base[1:, ::2],
        "turned": base.T,
        "wide": torch.ones(1, 3).expand(4, 3),
        "half": base.half(),
        "ids": torch.arange(3),
        "learnt": (2 * base).requires_grad_(),
        "parameter": torch.nn.Parameter(3 * base),
        "empty": torch.zeros(0, 3),
    }
    found = load_pickle(stored(tensors, protocol=protocol))
    for name, tensor in tensors.items():
        assert torch.equal(found[name], tensor.detach()), name
        assert not found[name].requires_grad
        assert np.array_equal(np.asarray(found[name]), tensor.detach().numpy())


@pytest.mark.parametrize("name", STORAGES.values())
def test_tensors_of_every_type(stored, name):
    tensor = torch.tensor([0, 1, 100]).to(getattr(torch, name))
    found = load_pickle(stored(tensor))
    assert found.dtype == tensor.dtype
    assert torch.equal(found, tensor)


def test_storages_that_are_not_plain_are_refused(stored):
    head = [MAGIC, VERSION, {"little_endian": True}]
    numbers = (2).to_bytes(8, "little") + bytes(8)

    def written(*, name=b"ctorch\nFloatStorage\n", length=2, view=b"N", big=False):
        pid = b"(S'storage'\n" + name + b"S'0'\nS'cpu'\n" + b"I%d\n" % length
        system = {"little_endian": not big}
        parts = [pickle.dumps(part, 2) for part in [*head[:2], system]]
        parts += [pid + view + b"tQ.", pickle.dumps(["0"], 2), numbers]
        call = Call(torch.storage._load_from_bytes, b"".join(parts))
        args = (call, 0, (2,), (1,), False, collections.OrderedDict())
        return stored(Call(torch._utils._rebuild_tensor_v2, *args))

    assert load_pickle(written()).tolist() == [0.0, 0.0]
    for changes in (
        {"name": b"S'load'\n"},
        {"name": b"ctorch\nload\n"},
        {"length": 3},
        {"view": b"(S'0'\nI0\nI1\nt"},
        {"big": True},
    ):
        with pytest.raises(DemoError):
            load_pickle(written(**changes))


def test_tensors_of_a_gpu_arrive_on_the_cpu(stored, monkeypatch):
    tensor = torch.arange(5.0)
    with monkeypatch.context() as patch:
        patch.setattr(torch.serialization, "location_tag", lambda _: "cuda:0")
        path = stored({"hand_pose": tensor})
        torch.save([tensor], path.with_suffix(".pt"))
    assert b"cuda:0" in path.read_bytes()
    assert torch.equal(load_pickle(path)["hand_pose"], tensor)
    assert torch.equal(load_torch(path.with_suffix(".pt"))[0], tensor)


def test_a_chumpy_model_is_read_without_chumpy(tmp_path):
    write_mano(tmp_path)
    model = load_pickle(tmp_path / "MANO_LEFT.pkl")
    hand = mano_hand("left")
    assert np.array_equal(model["shapedirs"], hand.shapedirs)
    assert np.array_equal(model["J_regressor"].toarray(), hand.regressor)
    assert model["bs_style"] == "lbs"
    assert "chumpy" not in sys.modules


def test_object_arrays_and_npz(tmp_path):
    held = {"params": {"transl": np.ones((2, 3))}, "n": 4}
    np.save(tmp_path / "dict.npy", np.array(held, dtype=object), allow_pickle=True)
    np.save(tmp_path / "list.npy", np.array([held, 1], dtype=object), allow_pickle=True)
    np.save(tmp_path / "plain.npy", np.asfortranarray(np.eye(3, 2)))
    np.savez_compressed(
        tmp_path / "all.npz",
        body=np.array(held, dtype=object),
        gender=np.array("male"),
        rot=np.eye(3),
    )
    assert same(load_npy(tmp_path / "dict.npy"), held)
    assert same(load_npy(tmp_path / "list.npy")[0], held)
    assert np.array_equal(load_npy(tmp_path / "plain.npy"), np.eye(3, 2))
    entries = load_npz(tmp_path / "all.npz")
    assert list(entries) == ["body", "gender", "rot"]
    assert same(entries["body"], held)
    assert entries["gender"] == "male"
    assert np.array_equal(entries["rot"], np.eye(3))


def test_parts_used_often_are_read_once(stored):
    part = [np.zeros(3)]
    for _ in range(22):
        part = [part, part]  # 2^22 leaves if each were visited
    found = load_pickle(stored(part))
    assert found[0] is found[1]


# How a hostile object gets into a file, and which reader meets it.
def _in_pickle(hostile, path, protocol):
    path.write_bytes(pickle.dumps({"deep": [hostile]}, protocol))
    return load_pickle


def _in_object_array(hostile, path, protocol):
    array = np.array([{"deep": hostile}], dtype=object)
    np.lib.format.write_array(path.open("wb"), array, allow_pickle=True)
    return load_npy


def _in_npz(hostile, path, protocol):
    np.savez(path.open("wb"), fine=np.eye(2), bad=np.array(hostile, dtype=object))
    return load_npz


def _in_torch_file(hostile, path, protocol):
    torch.save({"deep": hostile}, path, pickle_protocol=2)
    return load_torch


def _in_old_torch_file(hostile, path, protocol):
    torch.save(hostile, path, _use_new_zipfile_serialization=False)
    return load_torch


def _in_tensor_bytes(hostile, path, protocol):
    inner = io.BytesIO()
    torch.save(hostile, inner, _use_new_zipfile_serialization=False)
    outer = Call(torch.storage._load_from_bytes, inner.getvalue())
    path.write_bytes(pickle.dumps(outer, protocol))
    return load_pickle


HIDING = [_in_pickle, _in_object_array, _in_npz, _in_torch_file, _in_old_torch_file]
HIDING.append(_in_tensor_bytes)


@pytest.mark.parametrize("hide", HIDING)
@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("function", [os.system, builtins.eval, builtins.getattr])
def test_a_hostile_file_is_refused_by_name(tmp_path, hide, protocol, function):
    mark = tmp_path / "mark"
    told = {os.system: f"touch {mark}", eval: f"open({str(mark)!r}, 'w')"}
    args = [told[function]] if function in told else ["text", "upper"]
    path = tmp_path / "hostile"
    read = hide(Call(function, *args), path, protocol)
    with pytest.raises(DemoError) as caught:
        read(path)
    assert not mark.exists()
    text = str(caught.value)
    name = {os.system: "posix.system"}.get(function, function.__name__)
    assert re.search(rf"tried to load (\w+\.)?{name},", text)
    assert caught.value.code == "E_PICKLE"
    assert str(path) in text
    # the same file does harm where it is read without care
    if hide is _in_pickle and function is not getattr:
        pickle.loads(path.read_bytes())
        assert mark.exists()


@pytest.mark.parametrize(
    "ask",
    [
        b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.",  # dotted
        b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__dict__\x93.",
        b"cbuiltins\n__import__\n(S'os'\ntR.",
        b"cnumpy\nload\n.",
        b"cnumpy.core.multiarray\nfromfile\n.",
        b"ctorch\nload\n.",
        b"ctorch\nFloatStorage\n.",  # only inside of a tensor's own file
        b"cscipy.sparse.csc\nos\n.",
        b"cscipy.sparse\nlinalg.spsolve\n.",
        b"c__builtin__\nopen\n.",
        b"cfunctools\npartial\n.",
        b"cscipy.sparse\nload_npz\n.",
        b"cchumpy.ch\nos\n.",
        b"cflashdex.motions.unpickle\nload_pickle\n.",
        b"S'outside'\nQ.",  # persistent id
        b"\x82\x01.",  # extension code
    ],
)
def test_no_other_name_is_given_out(stored, ask):
    with pytest.raises(DemoError):
        load_pickle(stored(ask))


DTYPE = b"cnumpy\ndtype\n(S'%s'\nI0\nI1\ntR"
ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
FLOATS = DTYPE % b"f8" + b"(I3\nS'<'\nNNNI-1\nI-1\nI0\ntb"


@pytest.mark.parametrize(
    "made",
    [
        # more data announced than there are; sizes below zero, absurd, of no kind
        ARRAY + b"(I1\n(I9\nt" + FLOATS + b"I0\nS'12345678'\ntb.",
        ARRAY + b"(I1\n(I-1\nt" + FLOATS + b"I0\nS'12345678'\ntb.",
        ARRAY + b"(I1\n(I99999999999999\nt" + FLOATS + b"I0\nS''\ntb.",
        ARRAY + b"(I1\n(S'2'\nt" + FLOATS + b"I0\nS'12345678'\ntb.",
        # an array of pointers made of bytes
        ARRAY + b"(I1\n(I1\nt" + DTYPE % b"O8" + b"I0\nS'12345678'\ntb.",
        # dtypes with parts, without plain code
        DTYPE % b"V8" + b".",
        DTYPE % b"f8" + b"(I3\nS'<'\n(cnumpy\ndtype\nI2\ntNNI8\nI1\nI0\ntb.",
        DTYPE % b"M8" + b".",
        ARRAY + b".",  # without content
        b"cnumpy\nndarray\n(I9\ntR.",
        b"cnumpy\nndarray\n.",
        b"c_codecs\nencode\n(S'aa'\nS'hex'\ntR.",
        b"ccopyreg\n_reconstructor\n(cnumpy\nndarray\ncnumpy\ndtype\nNtR.",
        b"ccopyreg\n_reconstructor\n(cnumpy\nndarray\ncbuiltins\nobject\nI1\ntR.",
        b"ccopyreg\n_reconstructor\n(cbuiltins\nobject\ncbuiltins\nobject\nNtR.",
        b"cbuiltins\nbytes\n(I99999999999\ntR.",
        b"cbuiltins\nset\n.",
        b"cbuiltins\nbytes\n((I1\nI2\nltR.",  # of numbers
        b"ccollections\nOrderedDict\n(I7\ntR.",
        # items for a class, for an array, and a dict that is none
        b"ccollections\nOrderedDict\nS'make'\nI1\ns.",
        ARRAY + b"S'a'\nI1\ns.",
        b"ccollections\nOrderedDict\n(tR(dS'make'\nI1\nsb.",
        b"ccopyreg\n_reconstructor\n(ccopyreg\n_reconstructor\ncbuiltins\nobject\nNtR.",
        # a class where a value is wanted
        b"cbuiltins\nset\n((lcnumpy\ndtype\natR.",
        b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\nS'1'\ntR.",
        b"ctorch._utils\n_rebuild_parameter\n(cnumpy\nndarray\ntR.",
        # a state for a class by name of its slots
        b"cnumpy\ndtype\n(N(dS'make'\nI1\nstb.",
        # a state for a class would change it for the next file
        b"cchumpy.ch\nCh\n(N(dS'value'\nI1\nstb.",
        b"cscipy.sparse.csc\ncsc_matrix\n(N(dS'toarray'\nI1\nstb.",
        b"cnumpy.core.multiarray\n_reconstruct\n(N(dS'value'\nI1\nstb.",
    ],
)
def test_allowed_names_cannot_be_bent(stored, tmp_path, made):
    pickletools.dis(made, io.StringIO())  # a sound pickle, so it is not refused as torn
    with pytest.raises(DemoError):
        load_pickle(stored(made))
    write_mano(tmp_path, sides=("left",))
    model = load_pickle(tmp_path / "MANO_LEFT.pkl")
    assert np.array_equal(model["shapedirs"], mano_hand("left").shapedirs)


@pytest.mark.parametrize(
    "changes",
    [
        {"indices": np.array([0, 5, 1])},
        {"indices": np.array([0, -1, 1])},
        {"indices": np.array([0.0, 1.0, 1.0])},
        {"indptr": np.array([0, 1, 2, 9])},
        {"indptr": np.array([0, 9, 2, 3])},
        {"indptr": np.array([1, 1, 2, 3])},
        {"indptr": np.array([0, 3])},
        {"data": np.array([1.0])},
        {"_shape": (2, 10**9)},
        {"_shape": (10**6, 10**6)},
    ],
)
def test_indices_outside_of_a_matrix_are_refused(stored, changes):
    matrix = sp.csc_matrix(np.array([[1.0, 0, 2], [0, 3, 0]]))
    matrix.__dict__.update(changes)
    with pytest.raises(DemoError, match="sparse matrix"):
        load_pickle(stored(matrix))


@pytest.mark.parametrize(
    ("offset", "sizes", "strides"),
    [
        (0, (9,), (1,)),
        (3, (2,), (1,)),
        (0, (2, 2), (3, 1)),
        (0, (2,), (-1,)),
        (-1, (1,), (1,)),
        (0, (2,), (1, 1)),
        (0, (2**31, 2**10), (0, 0)),
    ],
)
def test_tensors_outside_of_their_storage_are_refused(stored, offset, sizes, strides):
    storage = torch.arange(4.0).untyped_storage()
    typed = torch.storage.TypedStorage(
        wrap_storage=storage, dtype=torch.float32, _internal=True
    )
    args = (typed, offset, sizes, strides, False, collections.OrderedDict())
    path = stored(Call(torch._utils._rebuild_tensor_v2, *args))
    with pytest.raises(DemoError):
        load_pickle(path)


def test_a_tree_that_contains_itself(stored):
    ring = []
    ring.append({"again": ring})
    with pytest.raises(DemoError, match="contains itself"):
        load_pickle(stored(ring))


def test_a_tree_too_deep(stored):
    with pytest.raises(DemoError, match="recursion"):
        load_pickle(stored(b"]" * 100_000 + b"a" * 99_999 + b"."))


def test_every_torn_file_is_told(tmp_path, stored):
    whole = pickle.dumps({"a": np.arange(3.0), "b": torch.ones(2)}, 2)
    for end in range(len(whole)):
        with pytest.raises(DemoError, match=r"file\.pkl: not a readable pickle"):
            load_pickle(stored(whole[:end]))
    np.savez(tmp_path / "a.npz", a=np.array({"b": 1}, dtype=object), c=np.eye(3))
    whole = (tmp_path / "a.npz").read_bytes()
    for end in range(0, len(whole), 7):
        with pytest.raises(DemoError, match=r"readable \.npz"):
            load_npz(stored(whole[:end]))
    torch.save({"a": torch.eye(3)}, tmp_path / "a.pt")
    whole = (tmp_path / "a.pt").read_bytes()
    for end in range(0, len(whole), 61):
        with pytest.raises(DemoError, match="readable torch file"):
            load_torch(stored(whole[:end]))


def test_damaged_bytes_never_raise_anything_else(stored):
    whole = pickle.dumps({"m": sp.csc_matrix(np.eye(3)), "t": torch.ones(2)}, 2)
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(1000):
        damaged = bytearray(whole)
        for place in rng.integers(2, len(whole), 3):
            damaged[place] = rng.integers(256)
        try:
            load_pickle(stored(bytes(damaged)))
        except DemoError:
            refused += 1
    assert refused > 500


@pytest.mark.parametrize(
    "greedy",
    [
        b"\x80\x02]r\xff\xff\xff\x7f.",  # place 2^31 of the memo: 32 GB of empty ones
        b"]p99999999999\n.",
        b"\x80\x04\x8e" + (2**36).to_bytes(8, "little") + b"x.",
        b"\x80\x05\x96" + (2**36).to_bytes(8, "little") + b"x.",
        b"\x80\x04\x8d" + (2**62).to_bytes(8, "little") + b"x.",
    ],
)
def test_lengths_that_are_not_there_cost_nothing(stored, greedy):
    tracemalloc.start()
    with pytest.raises(DemoError, match="not a readable"):
        load_pickle(stored(greedy))
    inner = Call(torch.storage._load_from_bytes, greedy)
    with pytest.raises(DemoError, match="not a readable"):
        load_pickle(stored(inner))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


def again(*what, count=200):
    """The same arguments for the same function, many times."""
    return [
        Built(Call(*call), state) if state else Call(*call)
        for call, state in [what] * count
    ]


EMPTY_ARRAY = (np._core.multiarray._reconstruct, np.ndarray, (0,), b"b")
SEEN = (torch.ones(1)._typed_storage(), 0, (10**6,), (0,), False)
SEEN += (collections.OrderedDict(),)
GROWING = {
    "arrays": again(EMPTY_ARRAY, (1, (9000,), np.dtype("u1"), False, bytes(9000))),
    "objects": again(EMPTY_ARRAY, (1, (9000,), np.dtype("O"), False, [0] * 9000)),
    "tensors": again((torch._utils._rebuild_tensor_v2, *SEEN), None, count=1),
    "sets": again((set, list(range(9000))), None),
    "texts": again((codecs.encode, "x" * 9000, "latin1"), None),
    "empty_sets": b"\x80\x04(" + b"\x8f" * 20_000 + b"l.",
    "empty_tables": b"\x80\x04(" + b"}" * 20_000 + b"l.",
    "objects_of_a_class": b"\x80\x02cnumpy\ndtype\nq\0(" + b"h\0)\x81" * 6000 + b"l.",
}


@pytest.mark.parametrize("case", GROWING)
def test_small_files_that_grow_are_stopped(stored, monkeypatch, case):
    for name in ("LEAST_ROOM", "MOST_GROWN"):
        monkeypatch.setattr(pickles, name, 10**6)
    path = stored(GROWING[case])
    assert path.stat().st_size < 10**5
    tracemalloc.start()
    with pytest.raises(DemoError, match="far more than the file holds"):
        load_pickle(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6  # not all in vain, but little more than is allowed


@pytest.mark.parametrize(("count", "told"), [(10**9, "not fit"), (10**12, "sizes")])
def test_arrays_of_absurd_size(tmp_path, stored, count, told):
    head = io.BytesIO()
    described = {"descr": "<f8", "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(head, described)
    path = stored(head.getvalue() + bytes(64), name="huge.npy")
    with pytest.raises(DemoError, match=told):
        load_npy(path)
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.write(path, "huge.npy")
    with pytest.raises(DemoError, match=told):
        load_npz(tmp_path / "huge.npz")


def test_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, a=np.zeros(100_000), b=np.zeros(100_000))
    # the archive's list, at its end, says 4 GiB - 2 for each entry
    raw = bytearray(path.read_bytes())
    start = raw.index(b"PK\x01\x02")
    for _ in range(2):
        raw[start + 24 : start + 28] = (2**32 - 2).to_bytes(4, "little")
        start = raw.find(b"PK\x01\x02", start + 4)
    path.write_bytes(bytes(raw))
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(DemoError, match="unpacks to 8192 MiB"):
        load_npz(path)
    with pytest.raises(DemoError, match="unpacks to 8192 MiB"):
        load_torch(path)


@pytest.mark.parametrize("load", [load_pickle, load_npy, load_npz, load_torch])
def test_files_of_another_kind(tmp_path, stored, load):
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    with pytest.raises(DemoError, match="Git-LFS pointer"):
        load(stored(pointer))
    with pytest.raises(DemoError, match="not a readable"):
        load(stored(b"just text, in no format at all\n"))
    with pytest.raises(DemoError, match="not a readable"):
        load(stored(b""))
    with pytest.raises(DemoError, match="No such file"):
        load(tmp_path / "absent")
    with pytest.raises(DemoError, match="cannot be read"):
        load(tmp_path)


def test_structured_arrays_with_objects_are_refused(tmp_path):
    kind = np.dtype([("a", object)])
    np.save(tmp_path / "a.npy", np.zeros(2, kind), allow_pickle=True)
    with pytest.raises(DemoError, match="not plain numbers or text"):
        load_npy(tmp_path / "a.npy")


def test_nothing_of_the_packages_is_handed_out():
    for name, given in pickles.ALLOWED.items():
        assert issubclass(given, pickles.StandIn), name
