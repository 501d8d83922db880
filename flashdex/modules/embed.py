"""The first layer: BatchNorm of the raw input, folded into a unit-row linear map."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from flashdex.modules.layers import Mode, UnitBatchNorm, UnitLinear, held
from flashdex.modules.product import product


class InputEmbed(nn.Module):
    """``UnitLinear(UnitBatchNorm([part_1, part_2, ...]))`` without an (E, B, D) tensor.

    Members usually see the same wide observation. Its statistics are then the same for
    all of them, so the input is normalised once, (B, D), and the affine part of each
    member moves into that member's weights:
    ``W (gamma x + beta) = (W gamma) x + W beta``.

    Args:
        in_features: total width D of all parts.
        width: output width.
        ensemble: number of members E.
        column_mask: optional (E, D) of 0 and 1; a member never sees its zero columns.
    """

    column_mask: Tensor | None

    def __init__(
        self,
        in_features: int,
        width: int,
        *,
        ensemble: int = 1,
        column_mask: Tensor | None = None,
    ) -> None:
        super().__init__()
        live = None if column_mask is None else int(column_mask[0].sum())
        self.norm = UnitBatchNorm(in_features, ensemble=ensemble, live=live)
        self.linear = UnitLinear(in_features, width, ensemble=ensemble)
        self.register_buffer("column_mask", column_mask, persistent=False)
        if column_mask is not None:
            with torch.no_grad():
                self.norm.weight.mul_(column_mask)
                self.linear.weight.mul_(column_mask[:, None])
            self.linear.project_()

    def forward(self, parts: Sequence[Tensor], *, mode: Mode) -> Tensor:
        """Embed the concatenation of ``parts`` to (E, B, width).

        A part is (B, d), seen by all members, or (E, B, d), one view a member; in the
        order of the input columns.
        """
        if mode == "train":
            centred, scale, shift = self._batch_normalise(parts)
        else:
            centred, scale, shift = self._running_normalise(parts, mode)
        weight = held(self.linear.weight, mode)
        if self.column_mask is not None:
            scale, shift = scale * self.column_mask, shift * self.column_mask
        bias = product(shift.unsqueeze(1), weight).squeeze(1)
        widths = [part.shape[-1] for part in parts]
        columns = zip(weight.split(widths, -1), scale.split(widths, -1), strict=True)
        folded = [w * s[:, None] for w, s in columns]
        return _sum_of_products(centred, folded, bias)

    def _batch_normalise(
        self, parts: Sequence[Tensor]
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        means = [p.mean(-2, keepdim=True) for p in parts]
        centred = [p - m for p, m in zip(parts, means, strict=True)]
        variances = [c.square().mean(-2, keepdim=True) for c in centred]
        mean, var = _concatenate(means), _concatenate(variances)
        self.norm.track_(mean, var, parts[0].shape[-2])
        scale = self.norm.weight * torch.rsqrt(var + self.norm.eps)
        return centred, scale, self.norm.bias

    def _running_normalise(
        self, parts: Sequence[Tensor], mode: Mode
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        gamma, beta = held(self.norm.weight, mode), held(self.norm.bias, mode)
        scale = gamma * torch.rsqrt(self.norm.running_var + self.norm.eps)
        # Any common centre is exact; member 0's mean keeps the products small, so that
        # a feature with a large offset does not lose digits in float32.
        centre = self.norm.running_mean[0]
        shift = beta - scale * (self.norm.running_mean - centre)
        centres = centre.split([p.shape[-1] for p in parts])
        return [p - c for p, c in zip(parts, centres, strict=True)], scale, shift


def _concatenate(rows: Sequence[Tensor]) -> Tensor:
    """Rows (1, d) or (E, 1, d) side by side: (1, D), or (E, D) if a member differs."""
    members = max(row.shape[0] for row in rows)
    flat = [row.reshape(-1, row.shape[-1]) for row in rows]
    return torch.cat([row.expand(members, -1) for row in flat], dim=-1)


def _sum_of_products(
    parts: Sequence[Tensor], weights: Sequence[Tensor], bias: Tensor
) -> Tensor:
    """``sum_i parts_i weights_i^T + bias``: one wide product per shared part."""
    ensemble, width = bias.shape
    shared: Tensor | None = None
    for part, weight in zip(parts, weights, strict=True):
        if part.dim() == 2:
            flat = weight.reshape(1, ensemble * width, -1)
            offset = bias.reshape(1, -1) if shared is None else None
            one = product(part.unsqueeze(0), flat, offset).squeeze(0)
            shared = one if shared is None else shared + one
    out = bias[:, None]
    if shared is not None:
        out = shared.unflatten(-1, (ensemble, width)).transpose(0, 1).contiguous()
    for part, weight in zip(parts, weights, strict=True):
        if part.dim() == 3:
            out = out + product(part, weight)
    return out
