"""The trunk that actors and critics share: embed, residual blocks, RMSNorm."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from flashdex.modules.embed import InputEmbed
from flashdex.modules.layers import (
    Mode,
    UnitBatchNorm,
    UnitLinear,
    UnitRMSNorm,
    dense_relu,
)

EXPANSION = 4


class FlashBlock(nn.Module):
    """``x + relu(BN(W2 relu(BN(W1 x))))`` with W1: d -> 4d and W2: 4d -> d."""

    def __init__(self, width: int, *, ensemble: int = 1) -> None:
        super().__init__()
        wide = EXPANSION * width
        self.linear1 = UnitLinear(width, wide, ensemble=ensemble)
        self.norm1 = UnitBatchNorm(wide, ensemble=ensemble)
        self.linear2 = UnitLinear(wide, width, ensemble=ensemble)
        self.norm2 = UnitBatchNorm(width, ensemble=ensemble)

    def forward(self, x: Tensor, *, mode: Mode, keep: slice | None = None) -> Tensor:
        """Transform ``x`` (E, B, d); return the rows ``keep`` (default: all)."""
        y = dense_relu(self.linear1, self.norm1, x, mode=mode)
        y = dense_relu(self.linear2, self.norm2, y, mode=mode, keep=keep)
        return (x if keep is None else x[:, keep]) + y


class FlashTrunk(nn.Module):
    """Embed, N residual blocks of width d and one RMSNorm, for E members at once.

    Example:
        >>> trunk = FlashTrunk(5, 8, ensemble=2)
        >>> trunk([torch.randn(16, 5)], mode="train").shape
        torch.Size([2, 16, 8])
    """

    def __init__(
        self,
        in_features: int,
        width: int,
        *,
        num_blocks: int = 2,
        ensemble: int = 1,
        column_mask: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.embed = InputEmbed(
            in_features, width, ensemble=ensemble, column_mask=column_mask
        )
        self.blocks = nn.ModuleList(
            FlashBlock(width, ensemble=ensemble) for _ in range(num_blocks)
        )
        self.norm = UnitRMSNorm(width, ensemble=ensemble)

    def forward(
        self, parts: Sequence[Tensor], *, mode: Mode, keep: slice | None = None
    ) -> Tensor:
        """Features (E, B, width) of the parts, (B, d_i) shared or (E, B, d_i).

        Only the rows ``keep`` are returned; all of them enter the batch statistics.
        """
        x = self.embed(parts, mode=mode)
        last = len(self.blocks) - 1
        for i, block in enumerate(self.blocks):
            x = block(x, mode=mode, keep=keep if i == last else None)
        return self.norm(x, mode=mode)
