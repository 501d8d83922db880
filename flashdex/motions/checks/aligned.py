"""Checks of an aligned motion and of the robot's reference for it."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import UP_ROTATION
from flashdex.datasets.support import lowest_points, still_runs
from flashdex.datasets.tracks import linear_velocity, rotation, runs
from flashdex.geometry.sdf import SdfGrid
from flashdex.motions.checks.objects import check_objects, check_overlap
from flashdex.motions.contact.activity import has_moved, motion_of
from flashdex.motions.contact.fingertips import local_tips
from flashdex.motions.contact.roles import Interaction
from flashdex.motions.findings import Finding, info, reject, warn
from flashdex.motions.retarget.solver import Attempt
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.meshes import hull_vertices

Up = Literal["z", "y", "-y"]

REACH = 1.0  # m
CONTACT_NEAR = 0.02  # m
ACTIVE_SECONDS = 0.3
TIP_DEPTH = (0.01, 0.02)  # m, warn and reject
BELOW, BELOW_LIMIT = 0.01, 0.05  # m, under the table
# m/s; recorded: at most 21 % of the time in which an object is faster than this, no
# finger is within 3 cm of it. Hands that are 0.2 s late: 39 to 59 %.
MOVING, NEAR = 0.15, 0.03
LEAST_SECONDS, ALONE = 0.2, 0.35


def check_aligned(
    motion: Interaction, assets: list[ObjectAsset], sdf: SdfGrid
) -> tuple[list[Finding], dict[str, float]]:
    """Objects, activity, contact, support and penetration of the human motion.

    Assets and the distances of their meshes are by slot.

    Returns:
        Findings, and figures for the report.
    """
    travel, turn = np.array([motion_of(pose) for pose in motion.poses]).T
    depth = _tip_depth(motion, sdf)
    figures = {
        "frames": motion.num_frames,
        "seconds": round(motion.num_frames / motion.fps, 3),
        "hands": " ".join(np.array(["left", "right"])[motion.active]),
        "objects": " ".join(motion.object_names),
        "object_travel_m": round(float(travel.max()), 4),
        "object_turn_deg": round(float(np.rad2deg(turn.max())), 1),
        "contact_share": round(float(motion.contact.any(axis=(1, 2)).mean()), 3),
        "nearest_tip_mm": round(1e3 * float(motion.tip_dist.min()), 2),
        "human_tip_depth_mm": round(1e3 * depth, 1),
    }
    found = check_objects(assets) + check_overlap(assets, motion.poses, sdf)
    found += _check_contact(motion) + check_left_out(motion)
    if depth > TIP_DEPTH[0]:
        finding = reject if depth > TIP_DEPTH[1] else warn
        text = f"a fingertip is {1e3 * depth:.0f} mm inside the object"
        found.append(finding("W_PEN", text))
    vertices = [hull_vertices(mesh) for mesh in motion.meshes]
    found += _check_support(motion, vertices)
    found += check_up(motion.poses, vertices, motion.fps, up=motion.up)
    return found + check_company(motion), figures


def _check_contact(motion: Interaction) -> list[Finding]:
    """Whether a hand does something to an object that moves."""
    nearest = float(motion.tip_dist.min())
    if nearest > REACH:
        return [reject("E_UNIT", f"no hand comes nearer than {nearest:.2f} m")]
    if any(has_moved(pose) for pose in motion.poses):
        if nearest > CONTACT_NEAR:
            text = f"an object moves, but no fingertip is nearer than {nearest:.3f} m"
            return [reject("R_CONTACT", text)]
        if not motion.active.any():
            return [reject("R_CONTACT", "an object moves, but no hand holds it")]
        return []
    touch = np.asarray(motion.contact.any(axis=2))
    least = max(round(ACTIVE_SECONDS * motion.fps), 1)
    if not any(runs(touch[:, hand], least=least) for hand in range(2)):
        text = f"no object moves, and no hand touches one for {ACTIVE_SECONDS} s"
        return [reject("R_INACTIVE", text)]
    return [warn("W_STATIC", "touched, but no object moves")]


def check_left_out(motion: Interaction) -> list[Finding]:
    """Objects for which there is no slot: harmless only while they lie still."""
    moving = [name for name, pose in motion.left_out.items() if has_moved(pose)]
    still = [name for name in motion.left_out if name not in moving]
    found = []
    if moving:
        text = f"{', '.join(moving)} moves but is left out: two objects at most"
        found.append(warn("W_OBJECTS", text))
    if still:
        text = f"{', '.join(still)} left out: two objects at most"
        found.append(info("I_OBJECTS", text))
    return found


def _tip_depth(motion: Interaction, sdf: SdfGrid) -> float:
    """Depth of human tips inside their object, 98th percentile of near samples, m."""
    depths = [0.0]
    for hand in np.flatnonzero(motion.active):
        slot = int(motion.hand_object[hand])
        local = local_tips(motion.keypoints[:, hand], motion.poses[slot])
        distance, _ = sdf.query(torch.tensor(local), torch.tensor(slot))
        near = distance[distance < CONTACT_NEAR].numpy()
        if near.size:
            depths.append(float(np.quantile(np.maximum(-near, 0), 0.98)))
    return max(depths)


def _check_support(motion: Interaction, vertices: list[np.ndarray]) -> list[Finding]:
    found = []
    if not motion.support_found:
        text = "nothing rests (are quaternions wxyz?); table at the lowest vertex"
        found.append(warn("W_SUPPORT", text))
    objects = zip(motion.object_names, motion.poses, vertices, strict=True)
    for name, pose, points in objects:
        low = lowest_points(pose, points)
        still = [low[a:b].min() for a, b in still_runs(pose, motion.fps)]
        if low.min() < -BELOW_LIMIT:
            text = f"'{name}' is {-100 * low.min():.0f} cm below the table"
            found.append(reject("R_BELOW", text))
        elif still and min(still) < -BELOW:
            text = f"'{name}' rests {-1e3 * min(still):.0f} mm below the table"
            found.append(warn("W_SUPPORT", text))
    return found


def check_company(motion: Interaction) -> list[Finding]:
    """Objects that move while the fingers that use them are elsewhere."""
    found = []
    for slot, pose in enumerate(motion.poses):
        users = np.flatnonzero(motion.hand_object == slot)
        if not len(users):
            continue  # what no hand uses is moved by another object
        speed = np.linalg.norm(linear_velocity(pose[:, :3], motion.fps), axis=-1)
        moving = speed > MOVING
        away = motion.tip_dist[:, users].min(axis=(1, 2)) > NEAR
        seconds = float(moving.sum()) / motion.fps
        share = float((moving & away).sum()) / max(int(moving.sum()), 1)
        if seconds > LEAST_SECONDS and share > ALONE:
            text = f"'{motion.object_names[slot]}' moves for {seconds:.1f} s, "
            text += f"{100 * share:.0f} % of it with no finger within 3 cm; are hands "
            text += "and objects of one clock and one world?"
            found.append(warn("W_ALONE", text))
    return found


IK_MEAN, IK_P95 = 0.02, 0.04  # m
SATURATION = 0.30
REFERENCE_DEPTH, TABLE_FRAMES = 0.02, 5
WRIST_ACCELERATION = 60.0  # m/s^2


def check_reference(
    motion: Interaction, attempt: Attempt, joint_range: np.ndarray
) -> tuple[list[Finding], dict[str, float]]:
    """Tip error, joint limits (2, J, 2) and penetration of the robot's reference.

    Returns:
        Findings, and figures for the report.
    """
    tip_error, depth = attempt.tip_error, attempt.depth
    mean, p95 = float(tip_error.mean()), float(np.quantile(tip_error, 0.95))
    fingers, ranges = attempt.joint_pos[:, :, 6:], joint_range[:, 6:]
    edge = 0.005 * (ranges[..., 1] - ranges[..., 0])
    at_limit = (fingers < ranges[..., 0] + edge) | (fingers > ranges[..., 1] - edge)
    saturated = float(at_limit[:, motion.active].mean())
    lengths = {
        "tip_error_median_mm": np.median(tip_error),
        "tip_error_p95_mm": p95,
        "penetration_median_mm": np.median(depth.objects),
        "penetration_p95_mm": np.quantile(depth.objects, 0.95),
        "penetration_max_mm": depth.objects.max(),
        "table_max_mm": depth.table.max(),
        "self_p95_mm": np.quantile(depth.own, 0.95),
        "hands_max_mm": depth.hands.max(),
    }
    figures = {name: round(1e3 * float(value), 2) for name, value in lengths.items()}
    figures["at_limit_share"] = round(saturated, 3)
    found = []
    if mean > IK_MEAN or p95 > IK_P95:
        text = f"robot tips {1e3 * mean:.0f} mm (p95 {1e3 * p95:.0f} mm) off human tips"
        found.append(warn("W_IK", text))
    if saturated > SATURATION:
        text = f"{100 * saturated:.0f} % of finger joint samples at a limit"
        found.append(warn("W_IK", text))
    if depth.objects.max() > REFERENCE_DEPTH:
        text = f"robot hand {1e3 * depth.objects.max():.0f} mm inside the object"
        found.append(warn("W_DEPTH", text))
    if runs(depth.table > REFERENCE_DEPTH, least=TABLE_FRAMES):
        text = f"robot hand {1e3 * depth.table.max():.0f} mm inside the table"
        found.append(warn("W_DEPTH", text))
    return found + _check_acceleration(motion), figures


def _check_acceleration(motion: Interaction) -> list[Finding]:
    wrist = motion.keypoints[:, motion.active, 0]
    smooth = (wrist[:-2] + wrist[1:-1] + wrist[2:]) / 3
    rate = np.gradient(np.gradient(smooth, axis=0), axis=0) * motion.fps**2
    largest = float(np.linalg.norm(rate, axis=-1).max())
    if largest <= WRIST_ACCELERATION:
        return []
    return [warn("W_ACCEL", f"wrist accelerates with {largest:.0f} m/s^2")]


WRONG = 0.02  # m: an axis whose table is violated by more is doubtful
RIGHT = 0.01  # m: the table of the suggested axis is violated by less
SURE = 0.1  # share of the fault that the table of another axis may have
RISE = 0.05  # m that something rises from the table, or the axis proves nothing
AXES = {f"+{'xyz'[i]}": axis for i, axis in enumerate(np.eye(3))}
AXES |= {f"-{'xyz'[i]}": -axis for i, axis in enumerate(np.eye(3))}


def check_up(
    poses: list[np.ndarray], vertices: list[np.ndarray], fps: float, *, up: Up = "z"
) -> list[Finding]:
    """Warn where another axis than z makes a clearly better table.

    A table is violated by objects that pass below it and by levels that differ between
    objects at rest at the start and at the end. Another axis is suggested only if its
    table holds, and something rises from it: a track in one plane proves nothing.

    Poses (T, 7) are of a world that is taken to be z up; vertices (m, (V, 3)) may be
    those of the hull; ``up`` is what the recording says, only to name its own axes.
    """
    # one frame of every still run at the start or the end
    spans = [still_runs(pose, fps) for pose in poses]
    last = len(poses[0])
    rest = [[(a + b) // 2 for a, b in s if a == 0 or b == last] for s in spans]
    if not any(rest):
        return []
    fault, _ = _table(poses, vertices, rest, AXES["+z"])
    if fault <= RIGHT:
        return []
    tables = {name: _table(poses, vertices, rest, axis) for name, axis in AXES.items()}
    # a smaller fault needs a table that is better beyond doubt
    right = RIGHT if fault > WRONG else SURE * fault
    better = {n: f for n, (f, rise) in tables.items() if f < right and rise > RISE}
    if not better:
        return []
    name = min(better, key=better.__getitem__)
    back = Rotation.from_euler("x", UP_ROTATION[up]).inv().apply(AXES[name])
    own = next(n for n, axis in AXES.items() if np.allclose(axis, back, atol=1e-6))
    text = (
        f"objects at rest miss one level by {100 * fault:.0f} cm along {up}, and by "
        f"{100 * better[name]:.1f} cm along {own}: is up {own}?"
    )
    return [warn("W_UP", text)]


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
