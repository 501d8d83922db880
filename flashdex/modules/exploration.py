"""Exploration noise that is held for a random number of steps."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor, nn

NoiseClock = Literal["shared", "per_env_hand"]


def zeta_cdf(exponent: float = 2.0, maximum: int = 16) -> Tensor:
    """Cumulative ``P(k) = k^-mu / sum_{j=1..max} j^-mu`` for k = 1..max, (max,)."""
    mass = torch.arange(1, maximum + 1, dtype=torch.float64).pow(-exponent)
    return (mass / mass.sum()).cumsum(0)


class NoiseRepetition(nn.Module):
    """Holds the standard normal draw of the policy for a truncated-zeta time.

    The draw is held, not the action: mean and std are those of the present step. With
    the ``shared`` clock all environments and groups redraw together; with
    ``per_env_hand`` each (group, environment) has its own clock.

    Args:
        exponent: mu of the zeta distribution.
        maximum: longest repetition, steps.
        clock: see above.
        generator: source of the draws; None is the global one.

    Example:
        >>> noise = NoiseRepetition()
        >>> noise((2, 64, 18)).shape
        torch.Size([2, 64, 18])
    """

    noise: Tensor
    count: Tensor
    length: Tensor
    cdf: Tensor

    def __init__(
        self,
        *,
        exponent: float = 2.0,
        maximum: int = 16,
        clock: NoiseClock = "shared",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.clock: NoiseClock = clock
        self.generator = generator
        self.register_buffer("cdf", zeta_cdf(exponent, maximum), persistent=False)
        self.register_buffer("noise", torch.zeros(0, 0, 0))
        self.register_buffer("count", torch.zeros(0, 0, dtype=torch.int64))
        self.register_buffer("length", torch.zeros(0, 0, dtype=torch.int64))

    @torch.no_grad()
    def forward(self, shape: tuple[int, int, int]) -> Tensor:
        """Standard normal noise of the next step.

        The shape is groups, environments, actions (G, N, A); a change redraws all.
        """
        fits = tuple(self.noise.shape) == tuple(shape)
        # a loaded state may come from the other clock
        if not fits or tuple(self.count.shape) != self._clocks(shape):
            self._allocate(shape)
        device = self.cdf.device
        fresh = torch.randn(shape, generator=self.generator, device=device)
        options = {"generator": self.generator, "device": device}
        uniform = torch.rand(self.count.shape, dtype=torch.float64, **options)
        # first index with u < cdf
        drawn = torch.searchsorted(self.cdf, uniform, right=True) + 1
        drawn = drawn.clamp_max(self.cdf.shape[0])
        redraw = self.count >= self.length
        self.noise.copy_(torch.where(redraw.unsqueeze(-1), fresh, self.noise))
        self.length.copy_(torch.where(redraw, drawn, self.length))
        self.count.copy_(torch.where(redraw, 1, self.count + 1))
        return self.noise.clone()

    def _clocks(self, shape: tuple[int, int, int]) -> tuple[int, int]:
        return (1, 1) if self.clock == "shared" else (shape[0], shape[1])

    def _allocate(self, shape: tuple[int, int, int]) -> None:
        self.noise = self.cdf.new_zeros(shape, dtype=torch.get_default_dtype())
        self.count = self.cdf.new_zeros(self._clocks(shape), dtype=torch.int64)
        self.length = torch.zeros_like(self.count)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # the saved number of environments may differ from the present one
        for name in ("noise", "count", "length"):
            saved = state_dict.get(prefix + name)
            if saved is not None:
                setattr(self, name, torch.empty_like(saved, device=self.cdf.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
