"""Signed distances to object surfaces, looked up in grids."""

from __future__ import annotations

import torch
from torch import Tensor, nn

NO_OBJECT_DISTANCE = 10.0  # m; what an empty object slot (index -1) is away


class SdfGrid(nn.Module):
    """Signed distance to object surfaces, precomputed on regular cubic grids.

    Values are metres, negative inside, expressed in the object frame. Queries outside
    the grid return the value on the boundary plus the distance to the box. The grids
    are buffers, so that they move with the module that holds them; they are data and
    stay out of checkpoints.

    Args:
        values: distances at the nodes, m, (num_objects, R, R, R), axes x, y, z.
        origin: lower corner (node 0, 0, 0) of each grid, m, (num_objects, 3).
        spacing: node spacing, m, (num_objects,).

    Example:
        >>> x = torch.linspace(-0.1, 0.1, 32)
        >>> nodes = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1)
        >>> ball = nodes.norm(dim=-1) - 0.05
        >>> grid = SdfGrid(ball[None], torch.full((1, 3), -0.1), x[1:2] - x[0])
        >>> distance, gradient = grid.query(torch.tensor([[0.0, 0.0, 0.06]]))
        >>> distance.round(decimals=3), gradient.round(decimals=2)[0, 2]
        (tensor([0.0100]), tensor(1.))
    """

    values: Tensor
    origin: Tensor
    spacing: Tensor
    _offset: Tensor

    def __init__(self, values: Tensor, origin: Tensor, spacing: Tensor) -> None:
        super().__init__()
        objects, *shape = values.shape
        if len(shape) != 3 or len(set(shape)) != 1 or shape[0] < 2:
            raise ValueError(
                f"values must be (num_objects, R, R, R), got {tuple(values.shape)}"
            )
        if origin.shape != (objects, 3) or spacing.shape != (objects,):
            raise ValueError(
                f"origin must be ({objects}, 3) and spacing ({objects},), got "
                f"{tuple(origin.shape)} and {tuple(spacing.shape)}"
            )
        self.resolution = shape[0]
        r = self.resolution
        corner = torch.cartesian_prod(*[torch.arange(2)] * 3)
        buffers = {"values": values.contiguous(), "origin": origin, "spacing": spacing}
        buffers["_offset"] = corner @ torch.tensor([r * r, r, 1])
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer, persistent=False)

    def query(
        self, points: Tensor, index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Trilinear distance and the unit direction of its analytic gradient.

        Args:
            points: in the frame of their object, m, (..., 3).
            index: row of the object of each point, int64, (...); leading axes
                broadcast. Negative: an empty slot, which is ``NO_OBJECT_DISTANCE``
                away with a zero gradient. None: row 0 for all.

        Returns:
            Signed distance, m, (...), and unit gradient in the object frame, (..., 3),
            zero where the interpolated field is flat.
        """
        if index is None:
            index = torch.zeros((), dtype=torch.int64, device=points.device)
        row = index.clamp_min(0)
        spacing = self.spacing[row][..., None]
        node = (points - self.origin[row]) / spacing
        # NaN (a diverged world) gives a NaN distance, not an index out of bounds.
        inside = node.nan_to_num(nan=0.0).clamp(0, self.resolution - 1)
        value, slope = self._interpolate(row, inside)
        over = (node - inside) * spacing
        beyond = torch.linalg.vector_norm(over, dim=-1, keepdim=True)
        # Outside, the clamped axes no longer change the boundary value.
        slope = torch.where(over == 0, slope, 0.0) / spacing
        slope = slope + over / beyond.clamp_min(1e-12)
        length = torch.linalg.vector_norm(slope, dim=-1, keepdim=True)
        empty = index < 0
        distance = torch.where(empty, NO_OBJECT_DISTANCE, value + beyond[..., 0])
        return distance, torch.where(
            empty[..., None], 0.0, slope / length.clamp_min(1e-9)
        )

    forward = query

    def _interpolate(self, row: Tensor, node: Tensor) -> tuple[Tensor, Tensor]:
        """Value (...) and slope per node (..., 3) at node coordinates (..., 3)."""
        r = self.resolution
        cell = node.floor().clamp_max(r - 2)
        x, y, z = (node - cell).unbind(-1)
        i, j, k = cell.long().unbind(-1)
        first = ((row * r + i) * r + j) * r + k
        corner = self.values.view(-1)[first[..., None] + self._offset].to(node.dtype)
        v000, v001, v010, v011, v100, v101, v110, v111 = corner.unbind(-1)
        # Along z, then y, then x; each slope is the same blend of differences.
        v00, v01 = torch.lerp(v000, v001, z), torch.lerp(v010, v011, z)
        v10, v11 = torch.lerp(v100, v101, z), torch.lerp(v110, v111, z)
        v0, v1 = torch.lerp(v00, v01, y), torch.lerp(v10, v11, y)
        dz0 = torch.lerp(v001 - v000, v011 - v010, y)
        dz1 = torch.lerp(v101 - v100, v111 - v110, y)
        slope = torch.stack(
            (v1 - v0, torch.lerp(v01 - v00, v11 - v10, x), torch.lerp(dz0, dz1, x)), -1
        )
        return torch.lerp(v0, v1, x), slope
