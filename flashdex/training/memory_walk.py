"""How many bytes a piece of torch code holds at its peak, without a device for it.

On the meta device tensors have shapes and no memory, so an update of any size can be
walked through in a moment: what each operator allocates and what is freed is counted.
"""

from __future__ import annotations

import weakref
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from flashdex.modules.product import bfloat16_products
from flashdex.objectives.batch import FlashBatch
from flashdex.objectives.flashsac import FlashSACLoss


class PeakMeter(TorchDispatchMode):
    """Counts the bytes of tensors that are made inside and still alive.

    Attributes:
        now: bytes alive.
        peak: most bytes alive at once.

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
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        given = {_storage(t)._cdata for t in _tensors((args, kwargs))}
        for made in _tensors(out):
            storage = _storage(made)
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


def _storage(tensor: Tensor) -> torch.UntypedStorage:
    return tensor.untyped_storage()


def tensor_bytes(tensors: Any) -> int:
    """Bytes of tensors, or of a tree of them."""
    return sum(t.numel() * t.element_size() for t in _tensors(tensors))


def make_flash_batch(
    loss: FlashSACLoss,
    *,
    size: int,
    observation: int,
    future: tuple[int, int] | None,
    device: str = "meta",
) -> tuple[FlashBatch, Tensor]:
    """A batch of B random transitions as the objectives read it, and its noise.

    Args:
        loss: networks and groups.
        size: transitions B.
        observation: width D.
        future: channels and frames of the future window, or None.
        device: where.
    """
    groups, action = len(loss.groups), loss.actor_network.action_dim
    with torch.device(device):
        window = None
        if future is not None:
            window = torch.randn(2 * size, future[1], future[0]).mT
        batch = FlashBatch(
            observation=torch.randn(2 * size, observation),
            future=window,
            action=torch.rand(size, groups * action),
            reward=torch.randn(groups, size),
            discount=torch.ones(size),
            terminated=torch.zeros(size),
            weight=torch.ones(groups, size),
        )
        return batch, torch.randn(groups, size, action)


def walk_flashsac(
    loss: FlashSACLoss, batch: FlashBatch, noise: Tensor, *, lowered: bool = False
) -> int:
    """Peak bytes of one update besides parameters, optimisers and gradients.

    The larger of the actor's and the critics' part, forward and backward, as the
    operators run one by one; a compiled update needs about as much.

    Args:
        loss: on the device of the batch; the networks' gradients are cleared.
        batch: of the size in question.
        noise: (G, B, A).
        lowered: large products in bfloat16.
    """
    parts: list[tuple[Any, nn.Module]] = [
        (loss.actor_objective, loss.actor_network),
        (loss.qvalue_objective, loss.qvalue_network),
    ]
    found = []
    for objective, network in parts:
        with PeakMeter() as meter, bfloat16_products(lowered):
            value, _ = objective(batch, noise)
            value.backward()
        # all gradients are there at the end, and counted with the networks
        found.append(meter.peak - gradient_bytes(network))
        network.zero_grad(set_to_none=True)
    return max(found)


def flashsac_flops(
    loss: FlashSACLoss, batch: FlashBatch, noise: Tensor, *, actor_period: int
) -> float:
    """Multiplications and additions of the matrix products of one update, on average.

    Args:
        loss: networks.
        batch: of the size in question.
        noise: (G, B, A).
        actor_period: updates an actor step.
    """
    counts = []
    for objective in (loss.actor_objective, loss.qvalue_objective):
        with FlopCounterMode(display=False) as counter:
            value, _ = objective(batch, noise)
            value.backward()
        counts.append(counter.get_total_flops())
        loss.zero_grad(set_to_none=True)
    actor, critic = counts
    return actor / actor_period + critic


def gradient_bytes(network: nn.Module) -> int:
    """Bytes of all gradients of a network."""
    return tensor_bytes([p for p in network.parameters() if p.requires_grad])
