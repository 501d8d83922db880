"""What a number is worth: clips that pass although nothing moves."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from flashdex.metrics.signals import Signals, compute_signals


def frozen_object(
    ref_pos: Tensor,
    ref_quat: Tensor,
    *,
    hand_active: Sequence[bool],
    hand_object: Sequence[int],
    fps: float = 60.0,
) -> Signals:
    """Signals of objects that stay at their first reference pose: pure arithmetic.

    Criteria with hand terms are not measured on it: there is no hand.

    Args:
        ref_pos: world, m, (T, O, 3).
        ref_quat: wxyz, (T, O, 4).
        hand_active: hands [left, right] that take part.
        hand_object: object slot of each hand, -1 without object.
        fps: control rate, Hz.
    """
    data = {
        "object_pos": ref_pos[:1].expand_as(ref_pos),
        "object_quat": ref_quat[:1].expand_as(ref_quat),
        "ref_object_pos": ref_pos,
        "ref_object_quat": ref_quat,
    }
    return compute_signals(
        data, hand_active=hand_active, hand_object=hand_object, fps=fps
    )
