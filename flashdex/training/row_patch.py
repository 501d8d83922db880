"""Rows that are not finite give way to sound ones, without the host looking at them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor


class RowPatch:
    """Puts copies of sound rows in the place of bad ones, and counts those.

    As many rows leave as come in, so the host need not know how many are bad: asking
    the device would stall it at every vector step. A bad row becomes a copy of the
    nearest sound row before it, else of the first sound one; where a whole step is bad,
    of a sound row of an earlier step. Before there is any, it is a blank row.

    Args:
        device: of the rows.
        ones: leaves that are 1 in a blank row, where all others are 0.

    Example:
        >>> patch = RowPatch(torch.device("cpu"))
        >>> rows = TensorDict({"x": torch.tensor([[1.0], [float("nan")], [3.0]])}, [3])
        >>> patch(rows, torch.tensor([True, False, True]))["x"].flatten().tolist()
        [1.0, 1.0, 3.0]
        >>> patch.count
        1
    """

    def __init__(self, device: torch.device, *, ones: Collection[str] = ()) -> None:
        self.ones = ones
        self._bad = torch.zeros((), dtype=torch.int64, device=device)
        self._spare: dict[str, Tensor] | None = None  # (1, ...) each

    @property
    def count(self) -> int:
        """Bad rows so far; waits for the device."""
        return int(self._bad)

    @count.setter
    def count(self, value: int) -> None:
        self._bad.fill_(value)

    def __call__(self, rows: TensorDict, good: Tensor) -> TensorDict:
        """Patch the rows of one step.

        Args:
            rows: flat, batch (N,).
            good: rows that are sound, (N,) bool.

        Returns:
            N sound rows, none of them shared with ``rows``.
        """
        size = len(good)
        self._bad += (~good).sum()
        own = torch.arange(size, device=good.device)
        before = torch.where(good, own, -1).cummax(0).values
        # the last row is the spare one, for a step without any sound row
        first = torch.where(good, own, size).amin()
        donor = torch.where(before < 0, first, before)
        leaves: dict[str, Any] = dict(rows.items())
        spare = self._spare or self._blank(leaves)
        patched = {
            key: torch.cat([leaf, spare[key]]).index_select(0, donor)
            for key, leaf in leaves.items()
        }
        self._spare = {key: leaf[-1:].clone() for key, leaf in patched.items()}
        return TensorDict(patched, batch_size=[size])

    def _blank(self, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
        fresh = {True: torch.ones_like, False: torch.zeros_like}
        return {k: fresh[k in self.ones](leaf[:1]) for k, leaf in leaves.items()}
