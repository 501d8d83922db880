"""Point sets: an even subset of a dense sample."""

from __future__ import annotations

import torch
from torch import Tensor


def farthest_point_sampling(points: Tensor, k: int) -> Tensor:
    """Indices of ``k`` points, each the farthest from those taken before it.

    The first is the farthest from the mean; ties go to the lower index, so that the
    result depends on the points alone. Any prefix of the result is itself an even
    subset.

    Args:
        points: m, (M, 3).
        k: number of points to take, 1 to M.

    Returns:
        Indices into ``points``, int64, (k,).

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0], [3, 0, 0]])
        >>> farthest_point_sampling(points, 3)
        tensor([3, 0, 2])
    """
    if not 1 <= k <= points.shape[0]:
        raise ValueError(f"k must be 1 to {points.shape[0]} (the points), got {k}")
    order = torch.empty(k, dtype=torch.int64, device=points.device)
    distance = (points - points.mean(dim=0)).square().sum(dim=-1)
    nearest = torch.full_like(distance, torch.inf)
    for i in range(k):
        pick = distance.argmax()
        order[i] = pick
        nearest = torch.minimum(nearest, (points - points[pick]).square().sum(dim=-1))
        # A taken point must not come again, not even among duplicates.
        nearest[pick] = -1.0
        distance = nearest
    return order
