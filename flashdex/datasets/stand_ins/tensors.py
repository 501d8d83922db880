"""Stand-ins for tensors of torch, and files of torch.

Every tensor of a pickle holds a whole torch file in the old layout, of a few hundred
bytes. Those are read here: ``torch.load`` takes a quarter of a millisecond for each,
which is minutes for a recording with ten tensors a frame.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from typing import IO, Any

from flashdex.datasets.stand_ins.base import (
    MAX_BYTES,
    RefusedError,
    StandIn,
    Value,
    check_pickle,
    check_sizes,
)

# what an old torch file begins with, and its version
MAGIC, VERSION = 0x1950A86A20F9469CFC6C, 1001
STORAGES = {
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}


class _Head(pickle.Unpickler):
    """Reads the head of an old torch file: numbers, texts, and one storage."""

    def find_class(self, module: str, name: str) -> str:
        if module != "torch" or name not in STORAGES:
            raise RefusedError(f"{module}.{name}")
        return STORAGES[name]

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _read_head(file: IO[bytes]) -> Any:
    start = file.tell()
    check_pickle(file)
    file.seek(start)
    return _Head(file).load()


def read_storage(raw: bytes) -> Any:
    """The numbers of one storage in the old layout, as a flat tensor on the CPU.

    Args:
        raw: what ``torch.storage._load_from_bytes`` would be called with.

    Raises:
        ValueError: it is not one, or is torn.
        RefusedError: it asks for something that is not data.
    """
    import torch  # slow to import, and few readers need it

    file = io.BytesIO(raw)
    magic, version, system, storage, keys = (_read_head(file) for _ in range(5))
    if (magic, version) != (MAGIC, VERSION) or not system["little_endian"]:
        raise ValueError("a torch storage of an unknown kind")
    kind, name, key, _, length = storage[:5]
    if kind != "storage" or keys != [key] or len(storage) > 6 or any(storage[5:]):
        raise ValueError("a torch storage that is a view of another")
    (told,) = struct.unpack("<q", file.read(8))
    data = bytearray(file.read())
    if name not in STORAGES.values():
        raise ValueError("a torch storage of an unknown type")
    dtype = getattr(torch, name)
    if told != length or len(data) != told * dtype.itemsize:
        raise ValueError(f"a torch storage of {length} numbers in {len(data)} bytes")
    return torch.frombuffer(data, dtype=dtype) if data else torch.empty(0, dtype=dtype)


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
            # torch's own text advises to read such a file without care
            text = "it is torn, or holds more than tensors in plain containers"
            raise ValueError(text) from error
        raise RefusedError(found.group(1)) from error


class Storage(StandIn):
    """``torch.storage._load_from_bytes``: a torch file within the pickle."""

    def value(self, plain: Value) -> Any:
        """Its numbers as a flat tensor, whatever device they came from."""
        data = plain(self.args[0])
        return read_storage(data.encode("latin1") if isinstance(data, str) else data)


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
