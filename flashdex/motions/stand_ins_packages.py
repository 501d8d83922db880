"""Stand-ins for what scipy, chumpy and torch put into pickles."""

from __future__ import annotations

import io
import math
import pickle
import re
from typing import IO, Any

import numpy as np
import scipy.sparse as sp

from flashdex.motions.stand_ins import (
    MAX_BYTES,
    RefusedError,
    StandIn,
    Value,
    check_sizes,
)


class Chumpy(StandIn):
    """``chumpy.ch.Ch``: an array with a history; only the array is wanted."""

    def value(self, plain: Value) -> np.ndarray:
        """The array."""
        return np.asarray(plain(self.state["x"]))


class ChumpySelect(StandIn):
    """``chumpy.reordering.Select``: elements of an array, in a new shape."""

    def value(self, plain: Value) -> np.ndarray:
        """The chosen elements."""
        flat = np.asarray(plain(self.state["a"])).ravel()
        places = np.asarray(plain(self.state["idxs"]), dtype=np.int64)
        return flat[places].reshape(check_sizes(plain(self.state["preferred_shape"])))


class Sparse(StandIn):
    """A matrix of ``scipy.sparse``, rebuilt only if its indices lie inside of it."""

    def value(self, plain: Value) -> Any:
        """The matrix, in the format it was stored in."""
        # scipy's C code reads wherever the indices point: check all of them first.
        parts = {str(key).lstrip("_"): part for key, part in self.state.items()}
        shape = check_sizes(plain(parts["shape"]))
        if len(shape) != 2:
            raise ValueError(f"a sparse matrix of shape {shape}")
        if math.prod(shape) > MAX_BYTES // 8:
            raise ValueError(f"a sparse matrix of shape {shape} is too large")
        data = np.asarray(plain(parts["data"]))
        rows, columns = self._places(parts, shape, plain)
        for places, size in ((rows, shape[0]), (columns, shape[1])):
            if places.shape != data.shape or data.ndim != 1:
                raise ValueError("a sparse matrix whose parts differ in length")
            if len(places) and not (places.min() >= 0 and places.max() < size):
                raise ValueError(f"a sparse matrix with entries outside of {shape}")
        return sp.coo_matrix((data, (rows, columns)), shape).asformat(self.layout)

    layout = "coo"

    def _places(
        self, parts: dict, shape: tuple[int, ...], plain: Value
    ) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of every entry."""
        if "coords" in parts:
            rows, columns = plain(parts["coords"])
        else:
            rows, columns = plain(parts["row"]), plain(parts["col"])
        return _whole(rows), _whole(columns)


class SparseColumns(Sparse):
    """``csc_matrix``: compressed by columns."""

    layout = "csc"

    def _places(
        self, parts: dict, shape: tuple[int, ...], plain: Value
    ) -> tuple[np.ndarray, np.ndarray]:
        inner, outer = _compressed(parts, shape[1], plain)
        return inner, outer


class SparseRows(Sparse):
    """``csr_matrix``: compressed by rows."""

    layout = "csr"

    def _places(
        self, parts: dict, shape: tuple[int, ...], plain: Value
    ) -> tuple[np.ndarray, np.ndarray]:
        inner, outer = _compressed(parts, shape[0], plain)
        return outer, inner


def _compressed(parts: dict, lines: int, plain: Value) -> tuple[np.ndarray, np.ndarray]:
    """Place of every entry within its line, and its line."""
    inner, starts = _whole(plain(parts["indices"])), _whole(plain(parts["indptr"]))
    if len(starts) != lines + 1 or starts[0] != 0 or starts[-1] != len(inner):
        raise ValueError("a sparse matrix whose line starts do not fit")
    counts = np.diff(starts)
    if (counts < 0).any():
        raise ValueError("a sparse matrix whose line starts go back")
    return inner, np.repeat(np.arange(lines), counts)


def _whole(values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1 or (array.dtype.kind not in "iu" and array.size):
        raise ValueError("a sparse matrix whose indices are not whole numbers")
    return array.astype(np.int64)


def load_tensors(file: IO[bytes]) -> Any:
    """The content of a torch file, on the CPU.

    Raises:
        RefusedError: it asks for something that is not data.
    """
    import torch  # slow to import, and few readers need it

    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        if found is None:
            raise
        raise RefusedError(found.group(1)) from error


class Storage(StandIn):
    """``torch.storage._load_from_bytes``: a torch file within the pickle."""

    def value(self, plain: Value) -> Any:
        """Its numbers as a flat tensor on the CPU, whatever device they came from."""
        import torch

        data = plain(self.args[0])
        raw = data.encode("latin1") if isinstance(data, str) else data
        stored = load_tensors(io.BytesIO(raw))
        if isinstance(stored, torch.Tensor):
            return stored.detach().reshape(-1)
        if not isinstance(stored, torch.storage.TypedStorage):
            raise ValueError(f"a torch storage that is a {type(stored).__name__}")
        # the public accessors of a typed storage warn that it is deprecated
        return torch.empty(0, dtype=stored.dtype).set_(stored._untyped_storage)


class Tensor(StandIn):
    """``torch._utils._rebuild_tensor``: a view of a storage."""

    def value(self, plain: Value) -> Any:
        """The tensor, without gradient."""
        import torch

        flat = plain(self.args[0])
        sizes, strides = (check_sizes(plain(part)) for part in self.args[2:4])
        (offset,) = check_sizes(plain(self.args[1]))
        if not isinstance(flat, torch.Tensor) or len(sizes) != len(strides):
            raise ValueError("a tensor without storage, or with odd strides")
        # torch would enlarge a storage that is too small: foreign memory shows then
        last = offset + sum((n - 1) * s for n, s in zip(sizes, strides, strict=True))
        count = math.prod(sizes)
        if count and last >= flat.numel():
            raise ValueError(f"a tensor of shape {sizes} that leaves its storage")
        if count * flat.element_size() > MAX_BYTES:
            raise ValueError(f"a tensor of shape {sizes} is too large")
        return flat.as_strided(sizes, strides, offset if count else 0).clone()


class Parameter(StandIn):
    """``torch._utils._rebuild_parameter``: a tensor that wants a gradient."""

    def value(self, plain: Value) -> Any:
        """The tensor, without gradient."""
        return plain(self.args[0])
