"""Continuous metrics: ADD and its areas, MPPE, path length, lift, smoothness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from flashdex.geometry.rotation import transform_points
from flashdex.metrics.errors import position_error

AUC_THRESHOLDS = tuple(k / 100 for k in range(1, 10))  # m
PROBE = 0.05  # m, arm of the six body-fixed points of MPPE
MIN_LIFT = 0.02  # m, reference rise below which the lift ratio has no meaning
MIN_PATH = 0.03  # m, reference path below which the path ratio has no meaning
MIN_REACH = 0.02  # m, of the reference from its start, to be followed
RULER = 0.01  # m, by which a path is measured: noise at rest is no path


def sample_vertices(vertices: Tensor, *, count: int = 500, seed: int = 42) -> Tensor:
    """Draw stored vertices (V, 3) uniformly, with replacement if there are too few.

    DexMachina draws 500 with seed 42, FlashCHORD uses seed 0.
    """
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(vertices), size=count, replace=len(vertices) < count)
    return vertices[torch.from_numpy(rows)]


def add_distance(
    vertices: Tensor, pos: Tensor, quat: Tensor, ref_pos: Tensor, ref_quat: Tensor
) -> Tensor:
    """ADD: ``mean_v |R v + p - (R_ref v + p_ref)|``, m, (...).

    Vertices (V, 3) are in the object frame, positions (..., 3) in the world, m;
    quaternions are wxyz, (..., 4).
    """
    simulated = transform_points(pos, quat, vertices)
    reference = transform_points(ref_pos, ref_quat, vertices)
    return position_error(simulated, reference).mean(-1)


def add_auc(add: Tensor) -> float:
    """Area under accuracy(tau) = share of frames with ADD < tau, tau = 1 ... 9 cm.

    Trapezoids, the nine thresholds spread over [0, 1]; ADD in m, pooled over any shape.
    """
    flat = add.double().flatten()
    accuracy = torch.stack([(flat < tau).double().mean() for tau in AUC_THRESHOLDS])
    return float(torch.trapezoid(accuracy, dx=1 / (len(AUC_THRESHOLDS) - 1)))


def add_auc_dexmachina(parts: Sequence[Tensor]) -> float:
    """Mean over parts of `add_auc`, of the ADD of each part, m, (T,)."""
    return sum(add_auc(part) for part in parts) / len(parts)


def mppe(pos: Tensor, quat: Tensor, ref_pos: Tensor, ref_quat: Tensor) -> Tensor:
    """Mean error of six body-fixed points at +-5 cm on the axes, max over bodies.

    Positions are world, m, (T, O, 3), quaternions (T, O, 4); mean over frames, m, ().
    """
    axes = torch.eye(3, dtype=pos.dtype, device=pos.device) * PROBE
    points = torch.cat((axes, -axes))
    return add_distance(points, pos, quat, ref_pos, ref_quat).amax(-1).mean()


def object_path_length(pos: Tensor) -> Tensor:
    """``sum_t |p_t+1 - p_t|`` of positions (T, ..., 3), m."""
    return position_error(pos[1:], pos[:-1]).sum(0)


def lift_ratio(pos: Tensor, ref_pos: Tensor) -> float | None:
    """``max_t (z - z_0)`` simulated over reference; None if the reference rises < 2 cm.

    Positions are world, m, (T, 3).
    """
    rise = (pos[:, 2] - pos[0, 2]).max()
    ref_rise = (ref_pos[:, 2] - ref_pos[0, 2]).max()
    return float(rise / ref_rise) if ref_rise >= MIN_LIFT else None


def ruler_path(pos: Tensor) -> float:
    """Path of positions (T, 3), m, by steps of a centimetre.

    The ruler is laid on where the position has left its last end by its length; what
    trembles nearer to it does not count.
    """
    points = pos.detach().cpu().double().numpy()
    length, first = 0.0, 0
    while first < len(points) - 1:
        gap = np.linalg.norm(points[first + 1 :] - points[first], axis=1)
        beyond = np.flatnonzero(gap >= RULER)
        if not len(beyond):
            return length + float(gap[-1])
        length += float(gap[beyond[0]])
        first += 1 + int(beyond[0])
    return length


def path_ratio(pos: Tensor, ref_pos: Tensor) -> float | None:
    """Path simulated over reference; None if the reference's is shorter than 3 cm.

    Positions are world, m, (T, 3); see ``ruler_path``.
    """
    ref = ruler_path(ref_pos)
    return ruler_path(pos) / ref if ref >= MIN_PATH else None


def follow_ratio(pos: Tensor, ref_pos: Tensor) -> float | None:
    """How much of the reference's way from its start is gone, at its times.

    The factor by which the reference's displacements fit those simulated best: 1 along
    with it, 0 at rest, trembling or across, negative the other way. None if it never is
    2 cm from its start. Positions are world, m, (T, 3).
    """
    way, ref = pos - pos[0], ref_pos - ref_pos[0]
    if float(torch.linalg.vector_norm(ref, dim=-1).max()) < MIN_REACH:
        return None
    return float((way * ref).sum() / ref.square().sum())


def off_by(ratio: float | None) -> float:
    """How far a ratio is from 1, up or down alike: 0.25 for 1.25 and for 0.8.

    At most 999, for a ratio of zero; 0 where there is none.
    """
    if ratio is None:
        return 0.0
    ratio = max(ratio, 1e-3)
    return max(ratio, 1 / ratio) - 1


def smoothness(qvel: Tensor, *, fps: float) -> float:
    """Mean squared joint acceleration, from differences of stored velocities (T, n)."""
    return float(((qvel[1:] - qvel[:-1]) * fps).square().mean())
