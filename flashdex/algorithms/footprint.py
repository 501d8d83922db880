"""What an algorithm keeps and an update takes, counted where tensors have no memory."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

_ADAM_STEP = 4  # bytes of Adam's own counter, one a parameter tensor


class PeakMeter(TorchDispatchMode):
    """Counts the bytes of tensors that are made inside and still alive.

    Example:
        >>> with PeakMeter() as meter:
        ...     x = torch.zeros(100, device="meta")
        ...     y = x[:10]  # a view is not counted again
        >>> meter.peak
        400
    """

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._alive: dict[int, int] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Run one operator and count what it made."""
        out = func(*args, **(kwargs or {}))
        given = {t.untyped_storage()._cdata for t in _tensors((args, kwargs))}
        for storage in (made.untyped_storage() for made in _tensors(out)):
            key = storage._cdata
            if key not in given and key not in self._alive:
                self._alive[key] = storage.nbytes()
                self.now += storage.nbytes()
                weakref.finalize(storage, self._free, key)
        self.peak = max(self.peak, self.now)
        return out

    def _free(self, key: int) -> None:
        self.now -= self._alive.pop(key, 0)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def tensor_bytes(tensors: Any) -> int:
    """Bytes of tensors, or of a tree of them."""
    return sum(t.numel() * t.element_size() for t in _tensors(tensors))


@dataclass(frozen=True)
class Networks:
    """Bytes that networks and their optimisers keep."""

    weights: int  # parameters and buffers, target network included
    gradients: int  # of what is trained
    moments: int  # both moments of Adam and its counters

    @classmethod
    def of(cls, network: nn.Module) -> Networks:
        """Count a module; parameters without gradient are not trained."""
        # LossModule lists the trained parameters only
        everything = [p for _, p in nn.Module.named_parameters(network)]
        trained = [p for p in everything if p.requires_grad]
        weights = tensor_bytes([everything, list(network.buffers())])
        gradients = tensor_bytes(trained)
        return cls(weights, gradients, 2 * gradients + _ADAM_STEP * len(trained))

    @property
    def total(self) -> int:
        """All of it."""
        return self.weights + self.gradients + self.moments


Update = Callable[[int], tuple[int, float]]
"""Rows -> most bytes of an update on them beside `Networks`, operations of products."""


def run_backward(compute: Callable[[], Tensor], network: nn.Module) -> tuple[int, int]:
    """Peak bytes of a loss and its backward pass, and the operations of its products.

    Gradients of the network are left out and cleared. Operators run one by one; a
    compiled update needs about as much.
    """
    with FlopCounterMode(display=False) as flops, PeakMeter() as meter:
        compute().backward()
    network.zero_grad(set_to_none=True)
    # all gradients are there at the end, and counted with the networks
    peak = meter.peak - Networks.of(network).gradients
    return peak, flops.get_total_flops()


@dataclass(frozen=True)
class Footprint:
    """Memory of a learner, from a rehearsal of two worlds."""

    networks: Networks
    input_bytes: int  # of an observation, as often as it lies there at once
    update: Update
