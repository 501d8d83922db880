"""Where replay rows live: on the learner's device, or in host memory beside it.

A row is about 1 kB, so the paper's 50 million rows are about 50 GB: they fit on the
largest accelerators and into the memory of most hosts. In host memory threads gather
the coming batches, and rows and batches cross over without the host waiting for the
device.
"""

from __future__ import annotations

from collections import deque
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, RoundRobinWriter

from flashdex.errors import FlashdexError
from flashdex.replay.codec import row_bytes


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


# Pushes that rows may be on their way to the host. They are waited for after that
# many vector steps, when they have long arrived, so that runs repeat themselves.
STAGES = 2


class RowBuffer(ReplayBuffer):
    """A ring of packed rows on the learner's device, or in host memory beside it.

    Rows for the host are copied without waiting for them. They can be sampled
    ``stages`` pushes later: never before they have arrived, and always at the same
    push. Threads gather whole batches ahead, under the lock that writing takes, so that
    no row is ever read half written.

    Args:
        capacity: rows of the ring.
        batch_size: rows B of one batch.
        device: of the learner.
        generator: draws the samples, where the rows are; with ``prefetch`` nobody else
            may draw from it.
        on_host: keep the rows in host memory, whatever the learner's device.
        stages: pushes that rows may be on their way.
        prefetch: batches that threads gather ahead; 0 gathers when asked.
        pinned: exchange rows through page-locked memory, which a CUDA device copies
            from and to while host and device go on.
    """

    def __init__(
        self,
        capacity: int,
        *,
        batch_size: int,
        device: torch.device,
        generator: torch.Generator,
        on_host: bool = False,
        stages: int = 0,
        prefetch: int = 0,
        pinned: bool = False,
    ) -> None:
        self.ring = RowStorage(
            capacity, device=torch.device("cpu") if on_host else device
        )
        super().__init__(
            storage=self.ring,
            writer=RowWriter(),
            generator=generator,
            pin_memory=pinned,
            prefetch=prefetch or None,
            # what threads gather has one size; otherwise every draw may have its own
            batch_size=batch_size if prefetch else None,
        )
        self.capacity, self.rows_per_batch = capacity, batch_size
        self.learner_device, self.generator = device, generator
        self.on_host, self.pinned = on_host, pinned
        self.stages, self.prefetch = stages, prefetch
        self._crosses = on_host and device.type != "cpu"
        self._coming: deque[tuple[TensorDict, torch.cuda.Event | None]] = deque()

    @property
    def num_rows(self) -> int:
        """Rows that can be sampled; asking waits for no thread."""
        return len(self.ring)

    def push(self, rows: TensorDict) -> None:
        """Take packed rows, (N,), of the learner's device; write what has arrived.

        Raises:
            FlashdexError: the ring does not fit into memory.
        """
        self._coming.append(self._send(rows))
        while len(self._coming) > self.stages:
            self._land()

    def _send(self, rows: TensorDict) -> tuple[TensorDict, torch.cuda.Event | None]:
        if not self._crosses:
            return rows, None
        # The allocator of pinned memory hands the same few blocks out again.
        copies = {
            key: torch.empty(
                leaf.shape, dtype=leaf.dtype, pin_memory=self.pinned
            ).copy_(leaf, non_blocking=self.pinned)
            for key, leaf in rows.items()
        }
        event = None
        if self.pinned:
            event = torch.cuda.Event()
            event.record(torch.cuda.current_stream(self.learner_device))
        return TensorDict(copies, batch_size=rows.batch_size), event

    def _land(self) -> None:
        rows, event = self._coming.popleft()
        if event is not None:
            event.synchronize()
        try:
            self.extend(rows)
        except RuntimeError as error:
            if self.ring.initialized:
                raise
            width = row_bytes(rows)
            raise FlashdexError(
                f"algo.buffer_size: {self.capacity} rows of {width} bytes are "
                f"{self.capacity * width / 1e9:.1f} GB, which {self.ring.device} "
                "cannot hold. Choose fewer rows, or on a CUDA device "
                "algo.replay=pinned, which keeps them in host memory."
            ) from error

    def draw(self, count: int = 1) -> TensorDictBase:
        """Rows of ``count`` batches on the learner's device, (count B,)."""
        if not self.prefetch:
            return self._to_learner(self.sample(count * self.rows_per_batch))
        batches: Any = [self._to_learner(self.sample()) for _ in range(count)]
        return batches[0] if count == 1 else cast(Any, torch.cat(batches))

    def _to_learner(self, rows: TensorDictBase) -> TensorDictBase:
        if not self._crosses:
            return rows
        return rows.to(self.learner_device, non_blocking=self.pinned)

    def flush(self) -> None:
        """Wait for the rows on their way and write them."""
        while self._coming:
            self._land()

    def empty(self, empty_write_count: bool = True) -> None:
        """Forget all rows, those on their way included."""
        self._coming.clear()
        super().empty(empty_write_count)


def check_pinning(device: torch.device) -> None:
    """Refuse pinned memory where a learner's device has none.

    Raises:
        FlashdexError: the learner is on no CUDA device, or pinning fails.
    """
    if device.type != "cuda":
        raise FlashdexError(
            "algo.replay: 'pinned' exchanges rows with a CUDA device, and this learner "
            f"is on '{device}'. Use algo.replay=auto, which keeps them there."
        )
    try:
        torch.empty(1, pin_memory=True)
    except RuntimeError as error:
        raise FlashdexError(
            f"algo.replay: no pinned memory can be had here ({error}). Use "
            "algo.replay=cpu, which needs none and waits for every copy, or "
            "algo.replay=device."
        ) from error
