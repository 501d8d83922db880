"""Which motion and which start frame a reset draws."""

from __future__ import annotations

import torch
from torch import Tensor


class UniformSampler:
    """Every motion alike.

    Args:
        num_motions: motions in the collection.
    """

    def __init__(self, num_motions: int) -> None:
        self.weights = torch.ones(num_motions)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Return motion rows, (count,) int64."""
        return torch.multinomial(self.weights, count, True, generator=generator)

    def mark_converted(self, motion: int) -> None:
        """Conversions change nothing here."""


class UnconvertedSampler(UniformSampler):
    """Converted motions are drawn less often, but never not at all.

    Args:
        num_motions: motions in the collection.
        converted_weight: weight of a converted motion against 1.
    """

    def __init__(self, num_motions: int, *, converted_weight: float = 0.25) -> None:
        super().__init__(num_motions)
        self.converted_weight = converted_weight

    def mark_converted(self, motion: int) -> None:
        """Lower the weight of ``motion``."""
        self.weights[motion] = self.converted_weight


SAMPLERS: dict[str, type[UniformSampler]] = {
    "uniform": UniformSampler,
    "unconverted": UnconvertedSampler,
}


def start_frames(length: Tensor, generator: torch.Generator) -> Tensor:
    """Reference state initialisation: uniform in [0, .99 T), int64.

    Args:
        length: frames of the drawn motions, (n,).
        generator: source of randomness.
    """
    draw = torch.rand(length.shape, generator=generator)
    return (draw * 0.99 * length).long()
