"""Which motion and which start frame a reset draws."""

from __future__ import annotations

import torch
from torch import Tensor


class MotionSampler:
    """Draws motions; converted ones, of a weight below 1, less often, but never not."""

    def __init__(
        self,
        num_motions: int,
        *,
        converted_weight: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.weights = torch.ones(num_motions, device=device)
        self.converted_weight = converted_weight

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Return motion rows, (count,) int64."""
        # Not torch.multinomial: some of its checks wait for the device.
        edges = self.weights.double().cumsum(0)
        draw = torch.rand(
            count, generator=generator, device=edges.device, dtype=edges.dtype
        )
        row = torch.searchsorted(edges, draw * edges[-1], right=True)
        return row.clamp_max(len(edges) - 1)

    def mark_converted(self, motion: int) -> None:
        """Lower the weight of ``motion``."""
        self.weights[motion] = self.converted_weight


# Weight of a converted motion, by the name of the sampler.
SAMPLERS = {"uniform": 1.0, "unconverted": 0.25}


def start_frames(length: Tensor, generator: torch.Generator) -> Tensor:
    """Reference state initialisation: uniform in [0, .99 T) of T frames, (n,) int64."""
    draw = torch.rand(length.shape, generator=generator, device=length.device)
    return (draw * 0.99 * length).long()
