"""Quality of a motion: findings with codes, and the figures of its report row.

A rejected motion stays out of the library; a flagged one is in it and is reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from flashdex.geometry.sdf import SdfGrid
from flashdex.keys import TIP_KEYPOINTS
from flashdex.motions.align import AlignedDemo
from flashdex.motions.demo import HumanDemo
from flashdex.motions.objects import ObjectAsset
from flashdex.motions.penetration import Penetration
from flashdex.motions.support import lowest_points, runs, still_runs
from flashdex.motions.tracks import rotation

Level = Literal["info", "warn", "reject"]
Status = Literal["kept", "flagged", "rejected"]

SECONDS = (1.0, 20.0)
JUMP_SPEED, JUMP_TURN, JUMP_STEP = 5.0, 30.0, 0.03  # m/s, rad/s, m
JUMP_RATIO, JUMP_EVENTS = 6.0, 5
PALM_LENGTH = (0.06, 0.12)  # m, wrist to middle MCP
EXTENTS = (0.005, 1.5)  # m, of a mesh
REACH = 1.0  # m
CONTACT_NEAR = 0.02  # m
STATIC_TRAVEL, STATIC_TURN = 0.02, np.deg2rad(15)
TIP_DEPTH = (0.01, 0.02)  # m, warn and reject
BELOW, BELOW_LIMIT = 0.01, 0.05  # m, under the table
IK_MEAN, IK_P95 = 0.02, 0.04  # m
SATURATION = 0.30
REFERENCE_DEPTH, TABLE_FRAMES = 0.02, 5
WRIST_ACCELERATION = 60.0  # m/s^2


@dataclass(frozen=True)
class Finding:
    """One remark about a motion."""

    code: str
    level: Level
    text: str


def status_of(findings: list[Finding]) -> Status:
    """Kept, flagged (a warning) or rejected."""
    levels = {f.level for f in findings}
    return (
        "rejected" if "reject" in levels else "flagged" if "warn" in levels else "kept"
    )


def check_demo(demo: HumanDemo) -> list[Finding]:
    """Length, jumps and units of the recording itself."""
    found = []
    if demo.seconds < SECONDS[0]:
        found.append(_reject("R_SHORT", f"{demo.seconds:.2f} s < {SECONDS[0]} s"))
    if demo.seconds > SECONDS[1]:
        text = f"{demo.seconds:.1f} s > {SECONDS[1]:.0f} s; cut it into segments"
        found.append(_reject("R_LONG", text))
    events = _jumps(demo)
    if events:
        text = f"{len(events)} jumps of hand or object, first in frame {events[0]}"
        level = "reject" if len(events) > JUMP_EVENTS else "warn"
        found.append(Finding("W_JUMP", level, text))
    for side, points in demo.keypoints.items():
        length = float(np.median(np.linalg.norm(points[:, 9] - points[:, 0], axis=-1)))
        if not PALM_LENGTH[0] < length < PALM_LENGTH[1]:
            text = f"{side} wrist to middle MCP {length:.3f} m; are these metres?"
            found.append(_reject("E_UNIT", text))
    return found


def _jumps(demo: HumanDemo) -> list[int]:
    """Frames after which a wrist or an object jumps."""
    tracks = [*demo.palm.values(), *(b.pose for b in demo.objects)]
    bad = np.zeros(demo.num_frames - 1, dtype=bool)
    for pose in tracks:
        step = np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=-1)
        turn = (rotation(pose[1:, 3:]) * rotation(pose[:-1, 3:]).inv()).magnitude()
        usual = np.array(
            [np.median(step[max(i - 7, 0) : i + 8]) for i in range(len(step))]
        )
        bad |= (step * demo.fps > JUMP_SPEED) | (turn * demo.fps > JUMP_TURN)
        bad |= (step > JUMP_RATIO * usual) & (step > JUMP_STEP)
    return np.flatnonzero(bad).tolist()


def check_aligned(
    aligned: AlignedDemo, assets: list[ObjectAsset], sdf: SdfGrid
) -> tuple[list[Finding], dict[str, float]]:
    """Activity, contact, support and penetration of the human motion."""
    travel, turn = _object_motion(aligned)
    nearest = aligned.tip_dist.min()
    figures = {
        "frames": aligned.num_frames,
        "seconds": round(aligned.num_frames / aligned.fps, 3),
        "hands": " ".join(np.array(["left", "right"])[aligned.active]),
        "objects": " ".join(aligned.object_names),
        "object_travel_m": round(float(travel.max()), 4),
        "object_turn_deg": round(float(np.rad2deg(turn.max())), 1),
        "contact_share": round(float(aligned.contact.any(axis=(1, 2)).mean()), 3),
        "nearest_tip_mm": round(1e3 * float(nearest), 2),
    }
    found = _check_meshes(assets)
    moves = (travel > STATIC_TRAVEL) | (turn > STATIC_TURN)
    if nearest > REACH:
        found.append(_reject("E_UNIT", f"no hand comes nearer than {nearest:.2f} m"))
    elif nearest > CONTACT_NEAR and moves.any():
        found.append(_reject("R_CONTACT", "the object moves but no fingertip is near"))
    elif not aligned.active.any():
        found.append(_reject("R_INACTIVE", "no hand touches an object"))
    elif not moves.any():
        found.append(Finding("W_STATIC", "warn", "touched, but no object moves"))
    depth = _tip_depth(aligned, sdf)
    figures["human_tip_depth_mm"] = round(1e3 * depth, 1)
    if depth > TIP_DEPTH[0]:
        level = "reject" if depth > TIP_DEPTH[1] else "warn"
        text = f"a fingertip is {1e3 * depth:.0f} mm inside the object"
        found.append(Finding("W_PEN", level, text))
    return found + _check_support(aligned), figures


def _object_motion(aligned: AlignedDemo) -> tuple[np.ndarray, np.ndarray]:
    """Largest travel (m) and turn (rad) from the first frame, per object."""
    travel, turn = [], []
    for pose in aligned.poses:
        travel.append(np.linalg.norm(pose[:, :3] - pose[0, :3], axis=-1).max())
        rot = rotation(pose[:, 3:])
        turn.append((rot * rot[0].inv()).magnitude().max())
    return np.array(travel), np.array(turn)


def _check_meshes(assets: list[ObjectAsset]) -> list[Finding]:
    found = []
    for asset in assets:
        size = float((asset.aabb[1] - asset.aabb[0]).max())
        if not EXTENTS[0] < size < EXTENTS[1]:
            text = f"'{asset.name}' is {size:.3g} m large; are these metres?"
            found.append(_reject("E_UNIT", text))
        if not asset.watertight:
            found.append(
                Finding("W_WATER", "info", f"'{asset.name}' is not watertight")
            )
    return found


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


def _check_support(aligned: AlignedDemo) -> list[Finding]:
    found = []
    if not aligned.support_found:
        text = "nothing rests; the table is where the lowest vertex was"
        found.append(Finding("W_SUPPORT", "warn", text))
    for name, pose, mesh in zip(
        aligned.object_names, aligned.poses, aligned.meshes, strict=True
    ):
        low = lowest_points(pose, np.asarray(mesh.vertices))
        still = [low[a:b].min() for a, b in still_runs(pose, aligned.fps)]
        if low.min() < -BELOW_LIMIT:
            text = f"'{name}' is {-100 * low.min():.0f} cm below the table"
            found.append(_reject("R_BELOW", text))
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
    errors = tip_error[:, aligned.active]
    mean, p95 = float(errors.mean()), float(np.quantile(errors, 0.95))
    fingers, ranges = joint_pos[:, :, 6:], joint_range[:, 6:]
    edge = 0.005 * (ranges[..., 1] - ranges[..., 0])
    at_limit = (fingers < ranges[..., 0] + edge) | (fingers > ranges[..., 1] - edge)
    saturated = float(at_limit[:, aligned.active].mean())
    figures = {
        "tip_error_median_mm": round(1e3 * float(np.median(errors)), 2),
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


def _reject(code: str, text: str) -> Finding:
    return Finding(code, "reject", text)
