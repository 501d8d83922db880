"""Checks of an aligned motion and of the robot's reference for it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import UP_ROTATION
from flashdex.datasets.support import lowest_points, still_runs
from flashdex.datasets.tracks import rotation, runs
from flashdex.geometry.sdf import SdfGrid
from flashdex.keys import TIP_KEYPOINTS
from flashdex.motions.align import AlignedDemo
from flashdex.motions.checks.objects import check_objects, check_overlap
from flashdex.motions.checks.recording import Finding, reject
from flashdex.motions.contact.activity import MOVE_TRAVEL, MOVE_TURN, motion_of
from flashdex.motions.retarget.penetration import Penetration
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.meshes import hull_vertices

Up = Literal["z", "y", "-y"]

WRONG = 0.02  # m: an axis whose table is violated by more is doubtful
RIGHT = 0.01  # m: the table of the suggested axis is violated by less
RISE = 0.05  # m that something rises from the table, or the axis proves nothing
AXES = {
    f"{sign}{'xyz'[i]}": (1.0 if sign == "+" else -1.0) * np.eye(3)[i]
    for i in range(3)
    for sign in "+-"
}


def check_up(
    poses: list[np.ndarray], vertices: list[np.ndarray], fps: float, *, up: Up = "z"
) -> list[Finding]:
    """Warn where another axis than z makes a clearly better table.

    A table is violated by objects that pass below it and by levels that differ between
    objects at rest at the start and at the end. Another axis is suggested only if its
    table holds, and something rises from it: a track in one plane proves nothing.

    Args:
        poses: of each object in a world that is taken to be z up, (T, 7).
        vertices: of each mesh (those of its hull do), m, (V, 3).
        fps: frames a second.
        up: what the recording says is up; only to name axes in its own world.
    """
    rest = [_ends_at_rest(pose, fps) for pose in poses]
    if not any(rest):
        return []
    fault, _ = _table(poses, vertices, rest, AXES["+z"])
    if fault <= WRONG:
        return []
    tables = {name: _table(poses, vertices, rest, axis) for name, axis in AXES.items()}
    better = {n: f for n, (f, rise) in tables.items() if f < RIGHT and rise > RISE}
    if not better:
        return []
    name = min(better, key=better.__getitem__)
    back = Rotation.from_euler("x", UP_ROTATION[up]).inv().apply(AXES[name])
    own = next(n for n, axis in AXES.items() if np.allclose(axis, back, atol=1e-6))
    text = (
        f"objects at rest miss one level by {100 * fault:.0f} cm along {up}, and by "
        f"{100 * better[name]:.1f} cm along {own}: is up {own}?"
    )
    return [Finding("W_UP", "warn", text)]


def _ends_at_rest(pose: np.ndarray, fps: float) -> list[int]:
    """One frame of every still run at the start or the end."""
    spans = still_runs(pose, fps)
    return [(a + b) // 2 for a, b in spans if a == 0 or b == len(pose)]


def _table(
    poses: list[np.ndarray],
    vertices: list[np.ndarray],
    rest: list[list[int]],
    axis: np.ndarray,
) -> tuple[float, float]:
    """How much the table along an axis is violated, and the rise above it, m."""
    lows = [
        ((axis @ rotation(p[:, 3:]).as_matrix()) @ v.T).min(axis=1) + p[:, :3] @ axis
        for p, v in zip(poses, vertices, strict=True)
    ]
    levels = [low[i] for low, frames in zip(lows, rest, strict=True) for i in frames]
    below = min(levels) - min(float(low.min()) for low in lows)
    rise = max(float(low.max()) for low in lows) - min(levels)
    return max(below, max(levels) - min(levels)), rise


REACH = 1.0  # m
CONTACT_NEAR = 0.02  # m
ACTIVE_SECONDS = 0.3
TIP_DEPTH = (0.01, 0.02)  # m, warn and reject
BELOW, BELOW_LIMIT = 0.01, 0.05  # m, under the table
IK_MEAN, IK_P95 = 0.02, 0.04  # m
SATURATION = 0.30
REFERENCE_DEPTH, TABLE_FRAMES = 0.02, 5
WRIST_ACCELERATION = 60.0  # m/s^2


def check_aligned(
    aligned: AlignedDemo, assets: list[ObjectAsset], sdf: SdfGrid, *, up: Up = "z"
) -> tuple[list[Finding], dict[str, float]]:
    """Objects, activity, contact, support and penetration of the human motion.

    Args:
        aligned: the motion.
        assets: its objects, by slot.
        sdf: distances of their meshes, by slot.
        up: axis that the recording says is up; only to name axes.

    Returns:
        Findings, and figures for the report.
    """
    travel, turn = _motions_of(aligned.poses)
    depth = _tip_depth(aligned, sdf)
    figures = {
        "frames": aligned.num_frames,
        "seconds": round(aligned.num_frames / aligned.fps, 3),
        "hands": " ".join(np.array(["left", "right"])[aligned.active]),
        "objects": " ".join(aligned.object_names),
        "object_travel_m": round(float(travel.max()), 4),
        "object_turn_deg": round(float(np.rad2deg(turn.max())), 1),
        "contact_share": round(float(aligned.contact.any(axis=(1, 2)).mean()), 3),
        "nearest_tip_mm": round(1e3 * float(aligned.tip_dist.min()), 2),
        "human_tip_depth_mm": round(1e3 * depth, 1),
    }
    found = check_objects(assets) + check_overlap(assets, aligned.poses, sdf)
    moves = (travel > MOVE_TRAVEL) | (turn > MOVE_TURN)
    found += _check_contact(aligned, moves=bool(moves.any()))
    found += _check_left_out(aligned)
    if depth > TIP_DEPTH[0]:
        level = "reject" if depth > TIP_DEPTH[1] else "warn"
        text = f"a fingertip is {1e3 * depth:.0f} mm inside the object"
        found.append(Finding("W_PEN", level, text))
    vertices = [hull_vertices(mesh) for mesh in aligned.meshes]
    found += _check_support(aligned, vertices)
    return found + check_up(aligned.poses, vertices, aligned.fps, up=up), figures


def _check_contact(aligned: AlignedDemo, *, moves: bool) -> list[Finding]:
    """Whether a hand does something to an object that moves."""
    nearest = float(aligned.tip_dist.min())
    if nearest > REACH:
        return [reject("E_UNIT", f"no hand comes nearer than {nearest:.2f} m")]
    if moves and nearest > CONTACT_NEAR:
        text = f"an object moves, but no fingertip is nearer than {nearest:.3f} m"
        return [reject("R_CONTACT", text)]
    if moves and not aligned.active.any():
        return [reject("R_CONTACT", "an object moves, but no hand holds it")]
    if moves:
        return []
    touch = np.asarray(aligned.contact.any(axis=2))
    least = max(round(ACTIVE_SECONDS * aligned.fps), 1)
    if not any(runs(touch[:, hand], least=least) for hand in range(2)):
        text = f"no object moves, and no hand touches one for {ACTIVE_SECONDS} s"
        return [reject("R_INACTIVE", text)]
    return [Finding("W_STATIC", "warn", "touched, but no object moves")]


def _check_left_out(aligned: AlignedDemo) -> list[Finding]:
    """Objects for which there is no slot: harmless only while they lie still."""
    if not aligned.left_out:
        return []
    travel, turn = _motions_of(aligned.left_out.values())
    moves = (travel > MOVE_TRAVEL) | (turn > MOVE_TURN)
    names = np.array(list(aligned.left_out))
    found = []
    if moves.any():
        text = f"{', '.join(names[moves])} moves but is left out: two objects at most"
        found.append(Finding("W_OBJECTS", "warn", text))
    if not moves.all():
        text = f"{', '.join(names[~moves])} left out: two objects at most"
        found.append(Finding("I_OBJECTS", "info", text))
    return found


def _motions_of(poses: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Largest travel (m) and turn (rad) from the first frame, per object."""
    travel, turn = np.array([motion_of(pose) for pose in poses]).T
    return travel, turn


def _tip_depth(aligned: AlignedDemo, sdf: SdfGrid) -> float:
    """Depth of human tips inside their object, 98th percentile of near samples, m."""
    depths = [np.zeros(1)]
    for hand in np.flatnonzero(aligned.active):
        slot = int(aligned.hand_object[hand])
        pose = aligned.poses[slot]
        tips = aligned.keypoints[:, hand][:, TIP_KEYPOINTS] - pose[:, None, :3]
        local = np.einsum("tji,tkj->tki", rotation(pose[:, 3:]).as_matrix(), tips)
        distance, _ = sdf.query(torch.tensor(local), torch.tensor(slot))
        near = distance[distance < CONTACT_NEAR].numpy()
        depths.append(np.maximum(-near, 0) if near.size else np.zeros(1))
    return float(max(np.quantile(d, 0.98) for d in depths))


def _check_support(aligned: AlignedDemo, vertices: list[np.ndarray]) -> list[Finding]:
    found = []
    if not aligned.support_found:
        text = "nothing rests (are quaternions wxyz?); table at the lowest vertex"
        found.append(Finding("W_SUPPORT", "warn", text))
    for name, pose, points in zip(
        aligned.object_names, aligned.poses, vertices, strict=True
    ):
        low = lowest_points(pose, points)
        still = [low[a:b].min() for a, b in still_runs(pose, aligned.fps)]
        if low.min() < -BELOW_LIMIT:
            text = f"'{name}' is {-100 * low.min():.0f} cm below the table"
            found.append(reject("R_BELOW", text))
        elif still and min(still) < -BELOW:
            text = f"'{name}' rests {-1e3 * min(still):.0f} mm below the table"
            found.append(Finding("W_SUPPORT", "warn", text))
    return found


def check_retarget(
    aligned: AlignedDemo,
    joint_pos: np.ndarray,
    tip_error: np.ndarray,
    depth: Penetration,
    joint_range: np.ndarray,
) -> tuple[list[Finding], dict[str, float]]:
    """Tip error, joint limits and penetration of the robot's reference."""
    mean, p95 = float(tip_error.mean()), float(np.quantile(tip_error, 0.95))
    fingers, ranges = joint_pos[:, :, 6:], joint_range[:, 6:]
    edge = 0.005 * (ranges[..., 1] - ranges[..., 0])
    at_limit = (fingers < ranges[..., 0] + edge) | (fingers > ranges[..., 1] - edge)
    saturated = float(at_limit[:, aligned.active].mean())
    figures = {
        "tip_error_median_mm": round(1e3 * float(np.median(tip_error)), 2),
        "tip_error_p95_mm": round(1e3 * p95, 2),
        "penetration_median_mm": round(1e3 * float(np.median(depth.objects)), 2),
        "penetration_p95_mm": round(1e3 * float(np.quantile(depth.objects, 0.95)), 2),
        "penetration_max_mm": round(1e3 * float(depth.objects.max()), 2),
        "table_max_mm": round(1e3 * float(depth.table.max()), 2),
        "self_p95_mm": round(1e3 * float(np.quantile(depth.own, 0.95)), 2),
        "hands_max_mm": round(1e3 * float(depth.hands.max()), 2),
        "at_limit_share": round(saturated, 3),
    }
    found = []
    if mean > IK_MEAN or p95 > IK_P95:
        text = f"robot tips {1e3 * mean:.0f} mm (p95 {1e3 * p95:.0f} mm) off human tips"
        found.append(Finding("W_IK", "warn", text))
    if saturated > SATURATION:
        text = f"{100 * saturated:.0f} % of finger joint samples at a limit"
        found.append(Finding("W_IK", "warn", text))
    if depth.objects.max() > REFERENCE_DEPTH:
        text = f"robot hand {1e3 * depth.objects.max():.0f} mm inside the object"
        found.append(Finding("W_DEPTH", "warn", text))
    if runs(depth.table > REFERENCE_DEPTH, least=TABLE_FRAMES):
        text = f"robot hand {1e3 * depth.table.max():.0f} mm inside the table"
        found.append(Finding("W_DEPTH", "warn", text))
    return found + _check_acceleration(aligned), figures


def _check_acceleration(aligned: AlignedDemo) -> list[Finding]:
    wrist = aligned.keypoints[:, aligned.active, 0]
    smooth = (wrist[:-2] + wrist[1:-1] + wrist[2:]) / 3
    rate = np.gradient(np.gradient(smooth, axis=0), axis=0) * aligned.fps**2
    largest = float(np.linalg.norm(rate, axis=-1).max())
    if largest <= WRIST_ACCELERATION:
        return []
    return [Finding("W_ACCEL", "warn", f"wrist accelerates with {largest:.0f} m/s^2")]
