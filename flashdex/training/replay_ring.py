"""The ring of replay rows: written by slices, gathered row by row."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, RoundRobinWriter


class RowStorage(LazyTensorStorage):
    """A ring of rows that are gathered whole, an order of magnitude faster on a CPU."""

    def get(self, index: Any) -> TensorDictBase:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Rows of ``index``; for (B,) int64, not negative, one gather a leaf."""
        is_list = isinstance(index, Tensor) and index.dim() == 1
        if not (self.initialized and is_list):
            return super().get(cast(Any, index))
        rows: Any = self._storage
        return rows.apply(
            lambda leaf: leaf.index_select(0, index), batch_size=[len(index)]
        )


class RowWriter(RoundRobinWriter):
    """Writes rows at the ring's cursor by slices, which are plain copies.

    TorchRL's own writer makes a tensor of positions and reads it on the host, which
    stalls a CUDA device at every step.
    """

    def extend(self, data: Any) -> Tensor:
        """Write rows (N,); returns their positions, on the host."""
        storage: Any = self._storage
        start, size, capacity = self._cursor, len(data), storage.max_size
        self._cursor = (start + size) % capacity
        self._write_count += size
        done = 0
        while done < size:
            at = (start + done) % capacity
            end = min(done + capacity - at, size)
            storage.set(slice(at, at + end - done), data[done:end])
            done = end
        return torch.arange(start, start + size, device="cpu") % capacity
