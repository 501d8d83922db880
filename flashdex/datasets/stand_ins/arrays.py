"""Stand-ins for arrays of numpy and of chumpy."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from flashdex.datasets.stand_ins.base import StandIn, Value, check_sizes

DTYPE_CODE = re.compile(r"[|<>=]?(b1|[iu][1248]|f[248]|c8|c16|O[48]?|[SU]\d{1,6})")


class ArrayType(StandIn):
    """``numpy.ndarray``, the class that ``_reconstruct`` names."""


class Dtype(StandIn):
    """``numpy.dtype`` of numbers, texts or objects; nothing structured."""

    def value(self, plain: Value) -> np.dtype:
        """The dtype; its state is (version, byte order, no parts, ...)."""
        code = plain(self.args[0])
        state = plain(self.state) or (3, "|", None, None, None)
        if not isinstance(code, str) or not DTYPE_CODE.fullmatch(code):
            raise ValueError(f"the array type {code!r} is not plain")
        if any(part is not None for part in state[2:5]):
            raise ValueError(f"the array type {code!r} has parts")
        order = state[1] if state[1] in ("<", ">") else "="
        kind = "O" if code.lstrip("|<>=").startswith("O") else code.lstrip("|<>=")
        return np.dtype(kind).newbyteorder(order)


class Array(StandIn):
    """``numpy.core.multiarray._reconstruct`` followed by its state."""

    def value(self, plain: Value) -> np.ndarray:
        """The array; the state is (version, shape, dtype, by columns, data)."""
        if self.args[0] is not ArrayType or self.state is None:
            raise ValueError("an array of an unknown class, or one without content")
        shape, dtype, by_columns, data = self.state[-4:]
        order = "F" if plain(by_columns) else "C"
        return make_array(plain(shape), plain(dtype), order, data, plain)


class BufferArray(StandIn):
    """``numpy.core.numeric._frombuffer``: an array of pickle protocol 5."""

    def value(self, plain: Value) -> np.ndarray:
        """The array; the arguments are data, dtype, shape and order."""
        data, dtype, shape, order = self.args
        return make_array(plain(shape), plain(dtype), plain(order), data, plain)


class Scalar(StandIn):
    """``numpy.core.multiarray.scalar``: one number."""

    def value(self, plain: Value) -> Any:
        """The numpy number."""
        return make_array((), plain(self.args[0]), "C", self.args[1], plain)[()]


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


def make_array(
    shape: Any, dtype: Any, order: Any, data: Any, plain: Value
) -> np.ndarray:
    """An array of checked size; nothing is allocated beyond the data at hand.

    Args:
        shape: as the file gives it.
        dtype: of the elements, native or not; the result is native.
        order: "C" by rows, "F" by columns.
        data: bytes, or latin-1 text of them; for objects the list of elements.
        plain: turns stand-ins into values.

    Raises:
        ValueError: shape and data do not fit together.
    """
    shape = check_sizes(shape)
    if not isinstance(dtype, np.dtype) or order not in ("C", "F"):
        raise ValueError("an array without type or order")
    count = math.prod(shape)
    data = plain(data)
    if dtype.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise ValueError(f"an array of shape {shape} without that many objects")
        flat = np.empty(count, dtype=object)
        for place, item in enumerate(data):
            flat[place] = item
        return flat.reshape(shape, order=order)
    raw = data.encode("latin1") if isinstance(data, str) else data
    size = count * dtype.itemsize
    if not isinstance(raw, (bytes, bytearray)) or len(raw) != size:
        raise ValueError(f"an array of shape {shape} whose data are not {size} bytes")
    if dtype.itemsize == 0:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))
    return flat.reshape(shape, order=order)
