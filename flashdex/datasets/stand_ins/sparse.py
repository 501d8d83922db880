"""Stand-ins for the sparse matrices of scipy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.sparse as sp

from flashdex.datasets.stand_ins.base import MAX_BYTES, StandIn, Value, check_sizes


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
