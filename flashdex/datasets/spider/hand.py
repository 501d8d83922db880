"""A whole hand from SPIDER's wrist pose and five fingertips.

SPIDER keeps no knuckles. Its readers of keypoints (GigaHands, HOT3D, the lifted sets)
build the wrist frame from them: z to the middle knuckle, y from the ring to the index
knuckle, x = y x z, with x and y turned round on the left hand; so on both sides x
points out of the palm and y to the index finger [read in its source, 44717007].
Its OakInk reader takes the frame from an intermediate file that is not published. So
the tips are asked: the documented frame is kept unless another choice of axes explains
them clearly better.

The other keypoints are filled from a nominal hand. They are plausible, not recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import (
    DISTAL_SHARE,
    GRASP,
    KNUCKLES,
    OPEN,
    PHALANGES,
    THUMB_BASE,
    THUMB_BONES,
    hand_keypoints,
)
from flashdex.datasets.tracks import rotation
from flashdex.keys import TIP_KEYPOINTS, Side

# columns: the palm's axes in SPIDER's wrist frame
DOCUMENTED = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
# The palm of this package lies on index and pinky, SPIDER's y on index and ring; the
# arch of the knuckles turns them apart about the fingers, deg, right hand; measured on
# 24 recorded hands: 6.4 to 9.9.
ARCH = 8.0
# another choice of axes must have an error smaller than this share of the documented
CLEARLY_BETTER = 0.6
MAX_BEND = 1.9  # rad, to which a finger is measured out; beyond, the chain is shrunk
NUM_BENDS = 200
MAX_SIZE = 1.3  # of the nominal hand; what is larger is not a hand
THUMB_ACROSS = np.array([0.8, 0.6, 0.0])  # the thumb bends to the fingers and across


@dataclass
class FilledHand:
    """Keypoints, m, world, (T, 21, 3), and how they were made."""

    keypoints: np.ndarray
    notes: dict[str, Any]


def fill_hand(
    wrist: np.ndarray,
    tips: np.ndarray,
    side: Side,
    *,
    wrist_in_palm: np.ndarray | None = None,
) -> FilledHand:
    """Keypoints whose wrist and tips are the recorded ones.

    Args:
        wrist: position (m) and quaternion wxyz of SPIDER's wrist frame, (T, 7); NaN
            where it was not tracked.
        tips: thumb to pinky, m, world, (T, 5, 3).
        side: of the hand.
        wrist_in_palm: where the wrist is, seen from the stored position in the axes of
            a right palm, m, (3,); None where the stored position is the wrist.
    """
    keypoints = np.full((len(wrist), 21, 3), np.nan)
    seen = np.isfinite(wrist).all(-1) & np.isfinite(tips).all(axis=(1, 2))
    if not seen.any():
        return FilledHand(keypoints, {})
    frame = rotation(wrist[seen, 3:]).as_matrix()
    offsets = tips[seen] - wrist[seen, None, :3]
    shift = np.zeros(3) if wrist_in_palm is None else wrist_in_palm * _mirror(side)
    shift = documented_axes(side) @ shift  # in the wrist frame
    local = np.einsum("tji,tkj->tki", frame, offsets) - shift
    axes, notes = find_axes(local, side)
    points, stretch = pose_hand(local @ axes, side)
    points = np.einsum("tij,tkj->tki", frame @ axes, points)
    keypoints[seen] = points + (wrist[seen, :3] + frame @ shift)[:, None]
    return FilledHand(keypoints, notes | stretch)


def find_axes(tips: np.ndarray, side: Side) -> tuple[np.ndarray, dict]:
    """The palm's axes in the wrist frame: documented, or those the tips speak for.

    Tips in the wrist frame, m, (T, 5, 3). The palm's axes are columns, (3, 3); with
    the distance of the tips to those of a nominal hand, m.
    """
    nominal = hand_keypoints(np.stack([OPEN, GRASP])).mean(0)[list(TIP_KEYPOINTS)]
    nominal = nominal * _mirror(side)
    mean = tips.mean(axis=0)
    errors = [(_rms(mean @ axes - nominal), i) for i, axes in enumerate(ALL_AXES)]
    own = _rms(mean @ DOCUMENTED - nominal)
    best, row = min(errors)
    told = {"tips_to_nominal_m": round(own, 4), "best_axes_m": round(best, 4)}
    if best >= CLEARLY_BETTER * own:
        return documented_axes(side), told | {"wrist_frame": "documented"}
    return ALL_AXES[row], told | {"wrist_frame": f"from the tips: {_name(row)}"}


def documented_axes(side: Side) -> np.ndarray:
    """The palm's axes in SPIDER's wrist frame, in columns, (3, 3)."""
    arch = Rotation.from_euler("x", ARCH * _mirror(side)[1], degrees=True)
    return DOCUMENTED @ arch.as_matrix()


def pose_hand(tips: np.ndarray, side: Side) -> tuple[np.ndarray, dict]:
    """A nominal hand in the palm frame with its fingers bent to reach the tips.

    Knuckles stand at nominal places, larger only if a tip were out of reach. The bend
    of the middle joint follows from the distance of tip and knuckle; the distal joint
    bends along. What is left is taken up by stretching, so that tips are exact. Tips
    (T, 5, 3) and keypoints (T, 21, 3) in the palm frame, m; with the stretch (95 %).
    """
    flip = _mirror(side)
    tips = tips * flip  # from here on a right hand
    size = _size(tips)
    points = np.zeros((len(tips), 21, 3))
    stretch = []
    for finger in range(5):
        base = (THUMB_BASE if finger == 0 else KNUCKLES[finger - 1]) * size
        bones = (THUMB_BONES if finger == 0 else PHALANGES[finger - 1]) * size
        chain, stretched = _chain(base, bones, tips[:, finger], thumb=finger == 0)
        points[:, 1 + 4 * finger : 5 + 4 * finger] = chain
        stretch.append(stretched)
    worst = float(np.quantile(np.abs(np.array(stretch) - 1), 0.95))
    return points * flip, {"hand_size": round(size, 3), "bone_stretch": round(worst, 3)}


def _chain(
    base: np.ndarray, bones: np.ndarray, tip: np.ndarray, *, thumb: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Knuckle, two joints and tip, (T, 4, 3), and how much bones are stretched, (T,).

    The chain is laid out flat, turned so that its end lies on the line to the tip.
    """
    reach = tip - base
    distance = np.linalg.norm(reach, axis=-1).clip(1e-6)
    along = reach / distance[:, None]
    # a finger bends about the palm's y; where the tip lies is told by ``along``
    inward = THUMB_ACROSS if thumb else np.cross(along, [0.0, 1.0, 0.0])
    inward = inward - np.sum(inward * along, -1, keepdims=True) * along
    inward = inward / np.linalg.norm(inward, axis=-1, keepdims=True).clip(1e-3)
    share = 1.0 if thumb else DISTAL_SHARE
    bends = np.linspace(0.0, MAX_BEND, NUM_BENDS)
    lengths = np.linalg.norm(_flat(bends, bones, share)[:, -1], axis=-1)
    bend = np.interp(-distance, -lengths, bends)  # both fall
    flat = _flat(bend, bones, share)
    end = flat[:, -1]
    length = np.linalg.norm(end, axis=-1)
    cos, sin = end[:, 0] / length, end[:, 1] / length
    ahead = flat[..., 0] * cos[:, None] + flat[..., 1] * sin[:, None]
    aside = flat[..., 1] * cos[:, None] - flat[..., 0] * sin[:, None]
    scale = distance / length
    joints = ahead[..., None] * along[:, None] + aside[..., None] * inward[:, None]
    return base + joints * scale[:, None, None], scale


def _flat(bend: np.ndarray, bones: np.ndarray, share: float) -> np.ndarray:
    """A bent finger in its plane, first bone along x, (..., 4, 2)."""
    angles = np.stack([0 * bend, bend, (1 + share) * bend], axis=-1)
    steps = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * bones[:, None]
    start = np.zeros((*bend.shape, 1, 2))
    return np.concatenate([start, np.cumsum(steps, axis=-2)], axis=-2)


def _size(tips: np.ndarray) -> float:
    """How much larger than nominal the hand must be to reach its tips, at least 1."""
    reach = np.linalg.norm(KNUCKLES, axis=-1) + PHALANGES.sum(-1)
    far = np.quantile(np.linalg.norm(tips[:, 1:], axis=-1), 0.99, axis=0)
    return float(np.clip((far / reach).max(), 1.0, MAX_SIZE))


def _mirror(side: Side) -> np.ndarray:
    return np.array([1.0, 1.0 if side == "right" else -1.0, 1.0])


def _rms(gaps: np.ndarray) -> float:
    return float(np.sqrt((gaps**2).sum(-1).mean()))


def _name(row: int) -> str:
    letters = ["xyz"[int(np.abs(column).argmax())] for column in ALL_AXES[row].T]
    signs = ["-" if column.sum() < 0 else "+" for column in ALL_AXES[row].T]
    return "palm xyz = wrist " + " ".join(
        map("".join, zip(signs, letters, strict=True))
    )


def _right_handed_axes() -> np.ndarray:
    """The 24 ways to lay a right-handed frame along another one's axes."""
    eye = np.eye(3)
    frames = [
        eye[:, list(order)] * np.array(signs)
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array([frame for frame in frames if np.linalg.det(frame) > 0])


ALL_AXES = _right_handed_axes()
