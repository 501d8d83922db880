"""How many torch threads a batch of worlds is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

# Below this many worlds a thread, waking the threads costs more than they save; beside
# the physics engine's own threads a barrier can even wait for the scheduler.
WORLDS_A_THREAD = 1024


@contextmanager
def few_threads(num_envs: int) -> Iterator[None]:
    """Run the block with at most one torch thread for every 1,024 worlds.

    Args:
        num_envs: worlds of the tensors inside.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, num_envs // WORLDS_A_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)
