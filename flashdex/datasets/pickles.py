"""Reads pickles without running anything that they ask for.

Licensed datasets come as pickles, object arrays and torch files (see ``files``). What a
pickle may name stands in ``ALLOWED``; every other name is refused and told. What it
names is a stand-in that only keeps what it is given; plain values are made of it
afterwards, from checked sizes and indices. So no name can be called to an effect, and
no class of a library is within reach. What a file becomes is bounded by its size,
before memory is taken for it.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
import sys
from collections.abc import Callable
from functools import partial
from typing import IO, Any

import numpy as np
import scipy.sparse as sp

from flashdex.system.pickled import HASHED, MAGIC, check_room, check_steps

MAX_BYTES = 2 << 30  # of a file, and of what it becomes
# What a file may become: a small one anything up to LEAST_ROOM, a larger one GROWTH
# times its size up to MOST_GROWN; beyond that, twice its size.
LEAST_ROOM, GROWTH, MOST_GROWN = 64 << 20, 32, 512 << 20
MAX_PARTS = 50_000_000  # of the containers of a file

DTYPE_CODE = re.compile(r"[|<>=]?(b1|[iu][1248]|f[248]|c8|c16|O[48]?|[SU]\d{1,6})")
# what an old torch file begins with (and ``MAGIC``), and the storages it may hold
VERSION = 1001
STORAGES = {
    **{"DoubleStorage": "float64", "FloatStorage": "float32", "HalfStorage": "float16"},
    **{"BFloat16Storage": "bfloat16", "LongStorage": "int64", "IntStorage": "int32"},
    **{"ShortStorage": "int16", "CharStorage": "int8", "ByteStorage": "uint8"},
    "BoolStorage": "bool",
}
ATOMS = (type(None), bool, int, float, complex, str, bytes, bytearray)
CONTAINERS, BUSY = (list, tuple, set, frozenset), object()
OLD_MODULES = {"__builtin__": "builtins", "copy_reg": "copyreg"}


class RefusedError(Exception):
    """A pickle asks for something that is not data; the text is its name."""


class StandIn:
    """Keeps what a pickle gives to an object: arguments, and a state or items."""

    args: tuple
    state: Any

    def __new__(cls, *args: Any) -> StandIn:
        """Keep the arguments here: pickles may skip ``__init__``."""
        made = object.__new__(cls)
        made.args, made.state = args, None
        return made

    # Every stand-in takes its state here: pickle would set attributes otherwise.
    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, item: Any) -> None:
        self.state = self.state or []
        self.state.append((key, item))

    @staticmethod
    def make(args: tuple, state: Any, room: int) -> Any:
        """The value, of plain arguments and a plain state, in ``room`` bytes."""
        raise ValueError("a bare class is not data")


def _stand_in(make: Callable[[tuple, Any, int], Any]) -> type[StandIn]:
    return type("StandIn", (StandIn,), {"make": staticmethod(make)})


def _encoded(args: tuple, state: Any, room: int) -> bytes:
    if args[1] not in ("latin1", "latin-1"):
        raise ValueError(f"bytes in the encoding {args[1]!r}")
    check_room(len(args[0]), room)
    return args[0].encode("latin1")


def _bytes(data: Any) -> Any:
    return data.encode("latin1") if isinstance(data, str) else data


def _old_object(args: tuple, state: Any, room: int) -> Any:
    """``copyreg._reconstructor``: an object of an old pickle."""
    kind, base, content = args
    if not issubclass(kind, StandIn) or base is not OBJECT or content is not None:
        raise ValueError("an old-style object that is not plain")
    return kind.make((), state, room)


def _dtype(args: tuple, state: Any, room: int) -> np.dtype:
    """Numbers, texts or objects; the state is (version, byte order, no parts, ...)."""
    state = state or (3, "|", None, None, None)
    if not isinstance(args[0], str) or not DTYPE_CODE.fullmatch(args[0]):
        raise ValueError(f"the array type {args[0]!r} is not plain")
    if any(part is not None for part in state[2:5]):
        raise ValueError(f"the array type {args[0]!r} has parts")
    code = args[0].lstrip("|<>=")
    order = state[1] if state[1] in ("<", ">") else "="
    return np.dtype("O" if code.startswith("O") else code).newbyteorder(order)


def _make_array(shape: Any, dtype: Any, order: Any, data: Any, room: int) -> np.ndarray:
    """An array of checked size; nothing is allocated beyond the data at hand."""
    shape = check_sizes(shape)
    if not isinstance(dtype, np.dtype) or order not in ("C", "F"):
        raise ValueError("an array without type or order")
    count = math.prod(shape)
    check_room(count * dtype.itemsize, room)
    if dtype.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise ValueError(f"an array of shape {shape} without that many objects")
        return np.fromiter(data, object, count).reshape(shape, order=order)
    raw, size = _bytes(data), count * dtype.itemsize
    if not isinstance(raw, (bytes, bytearray)) or len(raw) != size:
        raise ValueError(f"an array of shape {shape} whose data are not {size} bytes")
    if dtype.itemsize == 0:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))
    return flat.reshape(shape, order=order)


def check_sizes(given: Any) -> tuple[int, ...]:
    """Whole numbers from 0 up."""
    sizes = (given,) if isinstance(given, int) else given
    known = isinstance(sizes, (tuple, list)) and len(sizes) <= 32
    if not known or not all(
        isinstance(n, (int, np.integer)) and 0 <= n <= MAX_BYTES for n in sizes
    ):
        raise ValueError(f"{given!r} are not sizes")
    return tuple(int(n) for n in sizes)


def _chumpy_select(args: tuple, state: Any, room: int) -> np.ndarray:
    """Elements of an array, in a new shape."""
    flat = np.asarray(state["a"]).ravel()
    places = np.asarray(state["idxs"], dtype=np.int64)
    check_room(places.size * flat.itemsize, room)
    return flat[places].reshape(check_sizes(state["preferred_shape"]))


def _sparse(kind: Callable[..., Any], args: tuple, state: Any, room: int) -> Any:
    """A matrix whose indices are checked: scipy's C code reads where they point."""
    parts = {str(key).lstrip("_"): part for key, part in state.items()}
    shape = check_sizes(parts["shape"])
    if len(shape) != 2 or math.prod(shape) > MAX_BYTES // 8:
        raise ValueError(f"a sparse matrix of shape {shape}")
    names = ("row", "col") if kind is sp.coo_matrix else ("indices", "indptr")
    pair = parts["coords"] if "coords" in parts else [parts[name] for name in names]
    data, first, second = (np.asarray(part) for part in (parts["data"], *pair))
    whole = {first.dtype.kind, second.dtype.kind} <= {"i", "u"}
    if not whole or data.dtype.kind not in "biufc":
        raise ValueError("a sparse matrix of something else than numbers")
    try:
        if kind is sp.coo_matrix:
            return kind((data, (first, second)), shape)
        matrix = kind((data, first, second), shape)
        matrix.check_format(full_check=True)
    except ValueError as error:
        raise ValueError(f"a sparse matrix that is not sound: {error}") from error
    return matrix


def _storage(args: tuple, state: Any, room: int) -> Any:
    """Numbers of one storage, flat, on the CPU, whatever device they came from.

    Every tensor of a pickle holds a whole torch file in the old layout. ``torch.load``
    takes a quarter of a millisecond for each: minutes with ten tensors a frame.
    """
    import torch  # slow to import, and few readers need it

    check_room(len(args[0]), room)
    file = io.BytesIO(_bytes(args[0]))
    magic, version, system, storage, keys = (_load(file, _Head) for _ in range(5))
    kind, name, key, _, length = storage[:5]
    whole = kind == "storage" and keys == [key] and not any(storage[5:])
    if not whole or name not in STORAGES or not system["little_endian"]:
        raise ValueError("a torch storage that is not plain, or a view of another")
    if (magic, version) != (MAGIC, VERSION):
        raise ValueError("a torch storage of an unknown kind")
    dtype = getattr(torch, STORAGES[name])
    (told,) = struct.unpack("<q", file.read(8))
    data = bytearray(file.read())
    if told != length or len(data) != told * dtype.itemsize:
        raise ValueError(f"a torch storage of {length} numbers in {len(data)} bytes")
    return torch.frombuffer(data, dtype=dtype) if data else torch.empty(0, dtype=dtype)


def _tensor(args: tuple, state: Any, room: int) -> Any:
    """A view of a storage as a tensor of its own, without gradient."""
    import torch

    flat = args[0]
    sizes, strides = (check_sizes(part) for part in args[2:4])
    (offset,) = check_sizes(args[1])
    if not isinstance(flat, torch.Tensor) or len(sizes) != len(strides):
        raise ValueError("a tensor without storage, or with odd strides")
    # torch would enlarge a storage that is too small: foreign memory shows then
    last = offset + sum((n - 1) * s for n, s in zip(sizes, strides, strict=True))
    count = math.prod(sizes)
    if count and last >= flat.numel():
        raise ValueError(f"a tensor of shape {sizes} that leaves its storage")
    check_room(count * flat.element_size(), room)
    return flat.as_strided(sizes, strides, offset if count else 0).clone()


def _counted(room: int, items: Any = ()) -> Any:
    check_room(HASHED * len(items), room)
    return items


OBJECT = _stand_in(StandIn.make)
ALLOWED: dict[str, type[StandIn]] = {
    "builtins.object": OBJECT,
    "builtins.bytes": _stand_in(lambda args, *_: b"".join(args)),  # called on nothing
    "builtins.set": _stand_in(lambda args, _, room: set(_counted(room, *args))),
    "builtins.frozenset": _stand_in(
        lambda args, _, room: frozenset(_counted(room, *args))
    ),
    "collections.OrderedDict": _stand_in(
        lambda args, items, _: dict([*(args[0] if args else ()), *(items or ())])
    ),
    "_codecs.encode": _stand_in(_encoded),
    "copyreg._reconstructor": _stand_in(_old_object),
    "numpy.ndarray": _stand_in(StandIn.make),
    "numpy.dtype": _stand_in(_dtype),
    "numpy.core.multiarray._reconstruct": _stand_in(
        lambda _, s, room: _make_array(s[-4], s[-3], "CF"[bool(s[-2])], s[-1], room)
    ),
    "numpy.core.multiarray.scalar": _stand_in(
        lambda args, _, room: _make_array((), args[0], "C", args[1], room)[()]
    ),
    "numpy.core.numeric._frombuffer": _stand_in(  # pickle protocol 5
        lambda args, _, room: _make_array(args[2], args[1], args[3], args[0], room)
    ),
    "scipy.sparse.csc_matrix": _stand_in(partial(_sparse, sp.csc_matrix)),
    "scipy.sparse.csr_matrix": _stand_in(partial(_sparse, sp.csr_matrix)),
    "scipy.sparse.coo_matrix": _stand_in(partial(_sparse, sp.coo_matrix)),
    "chumpy.ch.Ch": _stand_in(lambda _, state, room: np.asarray(state["x"])),
    "chumpy.reordering.Select": _stand_in(_chumpy_select),
    "torch.storage._load_from_bytes": _stand_in(_storage),
    "torch._utils._rebuild_tensor": _stand_in(_tensor),
    "torch._utils._rebuild_tensor_v2": _stand_in(_tensor),
    "torch._utils._rebuild_parameter": _stand_in(lambda args, *_: args[0]),
}


class _Unpickler(pickle.Unpickler):
    """Builds containers, numbers, texts and stand-ins; refuses every other name."""

    def find_class(self, module: str, name: str) -> Any:
        top = OLD_MODULES.get(module, module).replace("numpy._core", "numpy.core")
        # ten years of scipy kept its matrices in as many modules
        top = "scipy.sparse" if top.startswith("scipy.sparse.") else top
        if f"{top}.{name}" not in ALLOWED or "." in name:
            raise RefusedError(f"{module}.{name}")
        return ALLOWED[f"{top}.{name}"]

    def persistent_load(self, pid: Any) -> Any:
        raise RefusedError(f"an object outside of the file ({str(pid)[:40]})")


class _Head(_Unpickler):
    """Reads the head of an old torch file, which names one storage."""

    def find_class(self, module: str, name: str) -> Any:
        is_storage = module == "torch" and name in STORAGES
        return name if is_storage else super().find_class(module, name)

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _load(file: IO[bytes], kind: type[pickle.Unpickler] = _Unpickler) -> Any:
    start = file.tell()
    check_steps(file, room=_room(file))
    file.seek(start)
    return kind(file, encoding="latin1").load()


def _room(file: IO[bytes]) -> int:
    """Bytes that the rest of a file may become."""
    start = file.tell()
    size = file.seek(0, io.SEEK_END) - start
    file.seek(start)
    return min(MAX_BYTES, max(LEAST_ROOM, min(GROWTH * size, MOST_GROWN), 2 * size))


def unpickle(file: IO[bytes]) -> Any:
    """The content of a pickle, of Python 2 or 3.

    Returns:
        Plain containers, numbers and texts; numpy arrays; scipy sparse matrices; torch
        tensors on the CPU without gradient. A chumpy array is a numpy array.

    Raises:
        RefusedError: it asks for anything else.
        ValueError: it is damaged; and nearly any other exception.
    """
    room = _room(file)
    tree = _load(file)
    done: dict[int, Any] = {}
    # parts of each container, shared ones as often as they are met: lists of the same
    # lists make billions of a few bytes for whoever goes over them
    parts: dict[int, int] = {}

    def plain(item: Any) -> Any:
        nonlocal room
        if type(item) in ATOMS:
            return item
        key = id(item)  # stays unique: the tree holds every item until the end
        if key not in done:
            done[key] = BUSY
            made = done[key] = _convert(item, plain, lambda: room)
            # one part of the file may be asked for in many forms, each a copy
            room -= getattr(made, "nbytes", 0) or sys.getsizeof(made)
            check_room(0, room)
            if length := len(made) if isinstance(made, (*CONTAINERS, dict)) else 0:
                inner = made.values() if isinstance(made, dict) else made
                parts[id(made)] = length + sum(parts.get(id(i), 0) for i in inner)
                if parts[id(made)] > MAX_PARTS:
                    raise ValueError(f"it has more than {MAX_PARTS} parts")
        if done[key] is BUSY:
            raise ValueError("a part that contains itself")
        return done[key]

    return plain(tree)


def _convert(item: Any, plain: Callable[[Any], Any], room: Callable[[], int]) -> Any:
    if isinstance(item, StandIn):
        args = tuple(a if isinstance(a, type) else plain(a) for a in item.args)
        made = type(item).make(args, plain(item.state), room())
        if isinstance(made, type):  # it may be an argument, but no value
            raise ValueError("a bare class is not data")
        return made
    if type(item) in CONTAINERS:
        return type(item)([plain(part) for part in item])
    if type(item) is dict:
        return {plain(key): plain(part) for key, part in item.items()}
    raise ValueError(f"a part that is not data ({type(item).__name__})")
