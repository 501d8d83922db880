"""States of random generators, which differ from device to device."""

from __future__ import annotations

import torch
from torch import Tensor


def restore_generator(generator: torch.Generator, state: Tensor) -> bool:
    """Set a generator to a stored state, unless that is one of another device.

    Args:
        generator: to set.
        state: what ``get_state`` of a generator returned.

    Returns:
        Whether it was set. Otherwise the generator goes on from its seed, as a run does
        that was trained on one device and goes on or is evaluated on another.
    """
    if state.numel() != generator.get_state().numel():
        return False
    generator.set_state(state.cpu())
    return True
