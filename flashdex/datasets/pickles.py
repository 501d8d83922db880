"""Reads files that hold pickles, without running anything that they ask for.

Licensed datasets come as pickles, object arrays and torch files. All of them are read
here and only here: the names that data need are allowed and met with stand-ins
(``stand_ins``); every other name is refused and told. Plain numpy arrays are read
by their announced size. No file becomes more than 4 GiB.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import IO, Any

import numpy as np

from flashdex.datasets.stand_ins import arrays, containers, sparse, tensors
from flashdex.datasets.stand_ins.base import (
    MAX_BYTES,
    RefusedError,
    StandIn,
    check_pickle,
    check_sizes,
)
from flashdex.errors import DemoError

LFS = b"version https://git-lfs"
OLD_MODULES = {"__builtin__": "builtins", "copy_reg": "copyreg"}
SPARSE = {
    "csc_matrix": sparse.SparseColumns,
    "csr_matrix": sparse.SparseRows,
    "coo_matrix": sparse.Sparse,
}
ALLOWED: dict[str, Any] = {
    "numpy.ndarray": arrays.ArrayType,
    "numpy.dtype": arrays.Dtype,
    "numpy.core.multiarray._reconstruct": arrays.Array,
    "numpy.core.multiarray.scalar": arrays.Scalar,
    "numpy.core.numeric._frombuffer": arrays.BufferArray,
    "_codecs.encode": containers.Encoded,
    "copyreg._reconstructor": containers.Reconstructor,
    "builtins.object": containers.ObjectType,
    "builtins.bytes": containers.NoBytes,
    "builtins.set": containers.MutableSet,
    "builtins.frozenset": containers.FrozenSet,
    "collections.OrderedDict": containers.Ordered,
    "chumpy.ch.Ch": arrays.Chumpy,
    "chumpy.reordering.Select": arrays.ChumpySelect,
    "torch.storage._load_from_bytes": tensors.Storage,
    "torch._utils._rebuild_tensor": tensors.Tensor,
    "torch._utils._rebuild_tensor_v2": tensors.Tensor,
    "torch._utils._rebuild_parameter": tensors.Parameter,
}


class _Unpickler(pickle.Unpickler):
    """Builds containers, numbers, texts and stand-ins; refuses every other name."""

    def find_class(self, module: str, name: str) -> Any:
        top = OLD_MODULES.get(module, module).replace("numpy._core", "numpy.core")
        if top.startswith("scipy.sparse") and name in SPARSE:
            return SPARSE[name]
        if f"{top}.{name}" not in ALLOWED or "." in name:
            raise RefusedError(f"{module}.{name}")
        return ALLOWED[f"{top}.{name}"]

    def persistent_load(self, pid: Any) -> Any:
        raise RefusedError(f"an object outside of the file ({str(pid)[:40]})")


def load_pickle(path: Path) -> Any:
    """The content of a pickle, of Python 2 or 3.

    Returns:
        Plain containers, numbers and texts; numpy arrays; scipy sparse matrices; torch
        tensors on the CPU without gradient. A chumpy array is a numpy array.

    Raises:
        DemoError: the file is missing, damaged, or asks for anything else.
    """
    return _guard(path, "pickle", lambda file: _unpickle(file))


def load_object_array(path: Path) -> Any:
    """The content of a ``.npy`` file, pickled or not.

    Returns:
        The array; of a pickled array without dimensions, its only element.

    Raises:
        DemoError: as ``load_pickle``.
    """
    size = path.stat().st_size if path.is_file() else 0
    return _guard(path, ".npy array", lambda file: _read_array(file, size))


def load_npz(path: Path, *, only: Collection[str] | None = None) -> dict[str, Any]:
    """The entries of a ``.npz`` file, each as ``load_object_array`` gives it.

    Args:
        path: the file.
        only: names of the entries that are wanted, as far as they are there.

    Raises:
        DemoError: as ``load_pickle``, or an entry announces more than 4 GiB.
    """
    return _guard(path, ".npz archive", lambda file: _read_npz(file, only))


def load_arrays(
    path: Path, *, only: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """The entries of a ``.npz`` file of plain arrays.

    Args:
        path: the file.
        only: names of the entries that are wanted, as far as they are there.

    Raises:
        DemoError: as ``load_npz``, or an entry holds objects.
    """
    entries = _guard(path, ".npz without pickles", lambda file: _read_npz(file, only))
    for name, array in entries.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind == "O":
            raise DemoError(
                f"{path}: not a readable .npz without pickles: '{name}' holds objects. "
                f"Store plain arrays; text as np.array([...], dtype=str)."
            )
    return entries


def load_torch(path: Path) -> Any:
    """The content of a file of ``torch.save``: tensors on the CPU, plain containers.

    Raises:
        DemoError: as ``load_pickle``.
    """
    return _guard(path, "torch file", _read_torch)


def _guard(path: Path, kind: str, read: Callable[[IO[bytes]], Any]) -> Any:
    """Read a file; whatever is wrong with it becomes one clear message."""
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise DemoError(f"{path}: cannot be read: a folder, a pipe or a device.")
    try:
        with path.open("rb") as file:
            if file.read(len(LFS)) == LFS:
                raise DemoError(
                    f"{path}: a Git-LFS pointer, not the file itself. Fetch it with "
                    f"'git lfs pull' or download it anew."
                )
            file.seek(0)
            return read(file)
    except DemoError:
        raise
    except RefusedError as error:
        raise DemoError(
            f"{path}: E_PICKLE: it tried to load {error}, which is not data, so it was "
            f"not read. Don't open it with anything else; get the file anew from where "
            f"the dataset is published."
        ) from error
    except OSError as error:
        raise DemoError(f"{path}: cannot be read: {error.strerror or error}") from error
    # Damaged bytes make pickle, zipfile, numpy and torch raise nearly any exception.
    except Exception as error:
        told = " ".join(str(error).split())[:200] or type(error).__name__
        raise DemoError(
            f"{path}: not a readable {kind}: {told}. It is damaged or incomplete, or "
            f"of another kind; unpack or download it anew."
        ) from error


def _unpickle(file: IO[bytes]) -> Any:
    data = io.BytesIO(file.read())
    check_pickle(data)
    data.seek(0)
    return to_value(_Unpickler(data, encoding="latin1").load())


def to_value(tree: Any) -> Any:
    """Plain values in place of the stand-ins of a pickle.

    Raises:
        ValueError: a part is not data, contains itself, or all is too large.
    """
    done: dict[int, Any] = {}
    busy: set[int] = set()
    size = 0

    def plain(item: Any) -> Any:
        nonlocal size
        if item is None or type(item) in (bool, int, float, complex, str):
            return item
        key = id(item)  # stays unique: the tree holds every item until the end
        if key in busy:
            raise ValueError("a part that contains itself")
        if key not in done:
            busy.add(key)
            made = done[key] = _convert(item, plain)
            busy.discard(key)
            # one part of the file may be asked for in many forms, each a copy
            size += getattr(made, "nbytes", 0) or 8 * _length(made)
            if size > MAX_BYTES:
                raise ValueError("it becomes more than 4 GiB")
        return done[key]

    return plain(tree)


def _length(made: Any) -> int:
    return len(made) if isinstance(made, (list, tuple, dict, set, frozenset)) else 0


def _convert(item: Any, plain: Callable[[Any], Any]) -> Any:
    if isinstance(item, StandIn):
        return item.value(plain)
    if type(item) in (list, tuple, set, frozenset):
        return type(item)([plain(part) for part in item])
    if type(item) is dict:
        return {plain(key): plain(part) for key, part in item.items()}
    if type(item) in (bytes, bytearray):
        return item
    raise ValueError(f"a part that is not data ({type(item).__name__})")


def _read_array(file: IO[bytes], size: int) -> Any:
    """An array of .npy bytes; ``size`` is how many there are."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, by_columns, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"version {version} of the format is not known")
    if dtype.kind == "O":
        array = _unpickle(file)
        if not isinstance(array, np.ndarray) or array.dtype.kind != "O":
            raise ValueError("an object array that holds something else")
        return array.item() if array.ndim == 0 else array
    count = math.prod(check_sizes(shape))
    if dtype.hasobject or count * dtype.itemsize > size:
        raise ValueError(f"shape {shape} of {dtype} does not fit to {size} bytes")
    data = file.read(count * dtype.itemsize)
    flat = np.frombuffer(bytearray(data), dtype, count)
    return flat.reshape(shape, order="F" if by_columns else "C")


def _read_npz(file: IO[bytes], only: Collection[str] | None = None) -> dict[str, Any]:
    with zipfile.ZipFile(file) as archive:
        members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
        _check_size(members)
        if not members:
            raise ValueError("it holds no .npy entries")
        entries = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            if only is not None and name not in only:
                continue
            data = io.BytesIO(archive.read(member))
            entries[name] = _read_array(data, member.file_size)
        return entries


def _check_size(members: list[zipfile.ZipInfo]) -> None:
    size = sum(member.file_size for member in members)
    if size > MAX_BYTES:
        raise ValueError(f"it unpacks to {size / 2**30:.0f} GiB, the limit is 4 GiB")


def _read_torch(file: IO[bytes]) -> Any:
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            _check_size(archive.infolist())
    file.seek(0)
    return tensors.load_tensors(file)
