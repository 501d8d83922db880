"""Errors between a rollout and its reference: the raw material of every score.

Row t of a rollout is the state AFTER control step t + 1; it is compared with row t of
the reference the step was scored on. All arithmetic is float64, so that a constant
error has exactly that mean.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from flashdex.geometry.rotation import quat_angle

Array = Tensor | np.ndarray


def position_error(pos: Tensor, ref_pos: Tensor) -> Tensor:
    """Distance of origins in the world, ``|p - p_ref|``, m: (..., 3) to (...)."""
    return torch.linalg.vector_norm(pos - ref_pos, dim=-1)


def centred_position_error(offset: Tensor) -> Tensor:
    """``|(p - mean_t p) - (p_ref - mean_t p_ref)|``: blind to a constant offset.

    Args:
        offset: ``p - p_ref`` over the scored window, world, m, (T, ..., 3).
    """
    return torch.linalg.vector_norm(offset - offset.mean(0, keepdim=True), dim=-1)


def joint_position_error(joints: Tensor, ref_joints: Tensor) -> Tensor:
    """Half the mean over level-1 links plus half the mean over distal links.

    Args:
        joints: robot link origins, level-1 links in the first half of M and distal
            links in the second, world, m, (..., M, 3) with M even.
        ref_joints: human joints in the same order, world, m, (..., M, 3).
    """
    distance = position_error(joints, ref_joints)
    if distance.shape[-1] % 2:
        raise ValueError(f"joints need an even count, got {distance.shape[-1]}")
    level, distal = distance.chunk(2, dim=-1)
    return 0.5 * (level.mean(-1) + distal.mean(-1))


def reference_drift(ref_pos: Tensor) -> Tensor:
    """``mean_t |p_ref,t - p_ref,0|`` of (T, ..., 3), m: below 1 mm it is static."""
    return position_error(ref_pos, ref_pos[:1]).mean(0)


def align_to_reference(
    num_frames: int, num_ref: int, *, fps: float, ref_fps: float, first_step: int = 1
) -> Tensor:
    """Rows of a rollout that belong to the reference rows: nearest earlier sample.

    Rates are in Hz. ``first_step`` is the time of row 0 in steps of its own rate: 1 for
    states after a step, 0 for tables that start with the initial state.

    Returns:
        Row indices, (K,), K <= num_ref: reference rows the rollout has reached.
    """
    steps = torch.arange(first_step, num_ref + first_step, dtype=torch.float64)
    # multiply first: the quotient of an exact multiple is exact, nothing falls short
    rows = torch.floor(steps * fps / ref_fps).long() - first_step
    return rows[(rows >= 0) & (rows < num_frames)]


@dataclass(frozen=True)
class TrackingErrors:
    """Errors of one rollout and the masks that say which of them count.

    Frames are the T rows of the rollout; sides and `hand_active` are [left, right].
    """

    object_pos_offset: Tensor | None  # p - p_ref in the world, m, (T, O, 3)
    object_rot_error: Tensor | None  # geodesic angle, rad, (T, O)
    ref_object_pos: Tensor | None  # the whole reference, world, m, (T_ref, O, 3)
    fingertip_error: Tensor | None  # robot tip to human tip, m, (T, 2, 5)
    joint_error: Tensor | None  # see `joint_position_error`, m, (T, 2)
    wrist_pos_error: Tensor | None  # m, (T, 2)
    hand_active: tuple[bool, bool]  # hands that take part
    hand_object: tuple[int, int]  # object slot of each hand, -1 without object
    num_frames: int  # T
    num_ref_frames: int  # T_ref, of the whole reference
    fps: float  # control rate, Hz
    missing: Mapping[str, str] = field(default_factory=dict)  # error -> absent key
    overflow: bool = False  # the engine dropped contacts or constraints

    @property
    def object_pos_error(self) -> Tensor | None:
        """Norm of the offset of the object frames, m, (T, O)."""
        if self.object_pos_offset is None:
            return None
        return torch.linalg.vector_norm(self.object_pos_offset, dim=-1)

    def slot(self, side: int) -> int:
        """Object slot of a hand, -1 if it has none or does not take part."""
        return self.hand_object[side] if self.hand_active[side] else -1

    def object_track(self, slot: int) -> tuple[Tensor, Tensor] | None:
        """Positions of one object, simulated and reference, world, m, (T, 3) each."""
        if self.object_pos_offset is None or self.ref_object_pos is None:
            return None
        offset = self.object_pos_offset[:, slot]
        reference = self.ref_object_pos[: len(offset), slot]
        return reference + offset, reference

    @property
    def slots(self) -> list[int]:
        """Slots of the hands' objects; a shared object appears once per hand."""
        return [s for s in (self.slot(0), self.slot(1)) if s >= 0]

    @property
    def is_finite(self) -> bool:
        """No NaN or infinity in anything that counts, and no engine overflow."""
        hands = [h for h in range(2) if self.hand_active[h]]
        parts = (
            (self.object_pos_offset, self.slots),
            (self.object_rot_error, self.slots),
            (self.fingertip_error, hands),
            (self.joint_error, hands),
            (self.wrist_pos_error, hands),
        )
        return not self.overflow and all(
            bool(x[:, rows].isfinite().all()) for x, rows in parts if x is not None
        )


def _pair(
    data: Mapping[str, Array | None], key: str, rows: Sequence[int]
) -> tuple[Tensor, Tensor] | str:
    """Simulated and reference array of an error, or the key that is not usable."""
    pair = []
    for name in (key, f"ref_{key}"):
        value = data.get(name)
        if value is None or 0 in value.shape:
            return name
        pair.append(torch.as_tensor(value, dtype=torch.float64))
    sim, ref = pair
    # a hole in the reference is a fault of the file, not of the policy
    if not bool(torch.isfinite(ref[:, list(rows)]).all()):
        return f"ref_{key}"
    length = min(len(sim), len(ref))
    return sim[:length], ref[:length]


def compute_tracking_errors(
    data: Mapping[str, Array | None],
    *,
    hand_active: Sequence[bool],
    hand_object: Sequence[int],
    fps: float = 60.0,
    num_ref_frames: int | None = None,
    overflow: bool = False,
) -> TrackingErrors:
    """Errors of one rollout against its reference.

    Args:
        data: ``object_pos`` (T, O, 3), ``object_quat`` (T, O, 4) wxyz, ``fingertips``
            (T, 2, 5, 3), ``joints`` (T, 2, M, 3), ``wrist_pos`` (T, 2, 3), each with
            its ``ref_`` twin; world, m. What is absent makes its error None.
        hand_active: hands [left, right] that take part.
        hand_object: object slot of each hand, -1 without object.
        fps: control rate, Hz.
        num_ref_frames: length of the reference; default: rows of ``ref_object_pos``.
        overflow: the engine dropped contacts or constraints.

    Example:
        >>> pose = {
        ...     "object_pos": torch.zeros(9, 1, 3),
        ...     "object_quat": torch.tensor([1.0, 0, 0, 0]).expand(9, 1, 4),
        ... }
        >>> data = pose | {f"ref_{k}": v for k, v in pose.items()}
        >>> compute_tracking_errors(
        ...     data, hand_active=(False, True), hand_object=(-1, 0)
        ... ).object_rot_error.max()
        tensor(0., dtype=torch.float64)
    """
    active = (bool(hand_active[0]), bool(hand_active[1]))
    slots = (int(hand_object[0]), int(hand_object[1]))
    hands = [h for h in range(2) if active[h]]
    used = sorted({slots[h] for h in hands if slots[h] >= 0})
    rows = {"object_pos": used, "object_quat": used}
    keys = ("object_pos", "object_quat", "fingertips", "joints", "wrist_pos")
    pairs = {key: _pair(data, key, rows.get(key, hands)) for key in keys}
    missing = {key: value for key, value in pairs.items() if isinstance(value, str)}
    found = {key: value for key, value in pairs.items() if not isinstance(value, str)}
    pos = found.get("object_pos")
    lengths = {len(sim) for sim, _ in found.values()} or {0}
    if len(lengths) > 1:
        raise ValueError(f"errors of different length: {sorted(lengths)}")
    total = data.get("ref_object_pos")
    num_frames = lengths.pop()
    default_ref = num_frames if total is None else len(total)

    def error(key: str, distance: Callable[..., Tensor]) -> Tensor | None:
        return distance(*found[key]) if key in found else None

    return TrackingErrors(
        object_pos_offset=None if pos is None else pos[0] - pos[1],
        object_rot_error=error("object_quat", quat_angle),
        ref_object_pos=None if pos is None else torch.as_tensor(total).double(),
        fingertip_error=error("fingertips", position_error),
        joint_error=error("joints", joint_position_error),
        wrist_pos_error=error("wrist_pos", position_error),
        hand_active=active,
        hand_object=slots,
        num_frames=num_frames,
        num_ref_frames=default_ref if num_ref_frames is None else num_ref_frames,
        fps=fps,
        missing=missing,
        overflow=overflow,
    )


def frozen_object(
    ref_pos: Tensor,
    ref_quat: Tensor,
    *,
    hand_active: Sequence[bool],
    hand_object: Sequence[int],
    fps: float = 60.0,
) -> TrackingErrors:
    """Errors of objects that stay at their first reference pose: pure arithmetic.

    Criteria with hand terms are not measured on it: there is no hand. Positions are
    world, m, (T, O, 3), quaternions wxyz, (T, O, 4). See `compute_tracking_errors`.
    """
    data = {
        "object_pos": ref_pos[:1].expand_as(ref_pos),
        "object_quat": ref_quat[:1].expand_as(ref_quat),
        "ref_object_pos": ref_pos,
        "ref_object_quat": ref_quat,
    }
    return compute_tracking_errors(
        data, hand_active=hand_active, hand_object=hand_object, fps=fps
    )
