"""A guard for tests: no operation may make the host wait for the device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_ATEN = torch.ops.aten
_WAITING = {
    _ATEN._local_scalar_dense,
    _ATEN.is_nonzero,
    _ATEN.nonzero,
    _ATEN.nonzero_numpy,
    _ATEN.masked_select,
    _ATEN.argwhere,
    _ATEN.unique_consecutive,
    _ATEN._unique,
    _ATEN._unique2,
    _ATEN.unique_dim,
    _ATEN.equal,
}
_INDEXED = {
    _ATEN.index,
    _ATEN.index_put,
    _ATEN.index_put_,
    _ATEN._index_put_impl_,
}


class _Forbid(TorchDispatchMode):
    """Raises on operations whose result the host must read or whose shape it needs."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        packet = func.overloadpacket
        if packet in _WAITING:
            raise AssertionError(f"{func} waits for the device")
        if packet in _INDEXED and any(_is_mask(i) for i in args[1]):
            raise AssertionError(f"{func} with a boolean index waits for the device")
        return func(*args, **kwargs)


def _is_mask(index: Tensor | None) -> bool:
    return index is not None and index.dtype in (torch.bool, torch.uint8)


@contextmanager
def forbid_sync() -> Iterator[None]:
    """Raise AssertionError on ``item``, ``nonzero``, masks as index and the like.

    It sees what torch dispatches, on any device, so it works without a GPU: reading a
    number, ``if tensor``, boolean indexing and masked assignment of a tensor. Copies
    to the host (``.cpu()``, ``.numpy()``) and other libraries are not seen.
    """
    with _Forbid():
        yield
