"""What a pickle from outside may build: stand-ins, made into values afterwards.

No object of a library is ever handed to the pickle machine. Each allowed name is a
class of this file that only keeps what it is given; ``to_value`` then builds plain
values from checked sizes and indices. So no name can be called to an effect, and no
class can be changed for the next file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

Value = Callable[[Any], Any]

MAX_BYTES = 4 << 30  # of one array; more is a mistake or an attack
DTYPE_CODE = re.compile(r"[|<>=]?(b1|[iu][1248]|f[248]|c8|c16|O[48]?|[SU]\d{1,6})")


class RefusedError(Exception):
    """A pickle asks for something that is not data; the text is its name."""


class StandIn:
    """Keeps the arguments and the state that a pickle gives to an object."""

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

    def value(self, plain: Value) -> Any:
        """The value this stands for; ``plain`` turns parts of it into values."""
        raise ValueError(f"a bare {type(self).__name__} is not data")


class ObjectType(StandIn):
    """``object``, the base that old pickles name."""


class ArrayType(StandIn):
    """``numpy.ndarray``, the class that ``_reconstruct`` names."""


class Reconstructor(StandIn):
    """``copyreg._reconstructor``: makes an empty object of an old pickle."""

    def __new__(cls, *args: Any) -> StandIn:
        """An empty object of the class that is asked for, if that is a stand-in."""
        kind, base, state = args
        if not issubclass(kind, StandIn) or base is not ObjectType or state is not None:
            raise ValueError("an old-style object that is not plain")
        return StandIn.__new__(kind)


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


class Encoded(StandIn):
    """``_codecs.encode``: how protocol 2 keeps bytes, as a latin-1 text."""

    def value(self, plain: Value) -> bytes:
        """The bytes."""
        text, codec = self.args
        if codec not in ("latin1", "latin-1"):
            raise ValueError(f"bytes in the encoding {codec!r}")
        return plain(text).encode("latin1")


class NoBytes(StandIn):
    """``bytes`` as protocol 2 calls it: without arguments."""

    def value(self, plain: Value) -> bytes:
        """No bytes."""
        if self.args:
            raise ValueError("bytes made of something")
        return b""


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


def check_sizes(sizes: Any) -> tuple[int, ...]:
    """Sizes as a tuple of whole numbers from 0 up.

    Raises:
        ValueError: they are something else.
    """
    sizes = (sizes,) if isinstance(sizes, int) else sizes
    if not isinstance(sizes, (tuple, list)):
        raise ValueError(f"{sizes!r} are not sizes")
    whole = [isinstance(n, (int, np.integer)) and 0 <= n <= MAX_BYTES for n in sizes]
    if not all(whole) or len(sizes) > 32:
        raise ValueError(f"{sizes!r} are not sizes")
    return tuple(int(n) for n in sizes)
