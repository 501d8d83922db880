"""From one demonstration to one library motion: align, reference, check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import angular_velocity, linear_velocity
from flashdex.errors import DemoError, MeshError
from flashdex.hands.collision_spheres import HandModel
from flashdex.hands.spec import HandSpec, load_hand
from flashdex.keys import SIDES, Side
from flashdex.motions.align import AlignedDemo, align
from flashdex.motions.checks.aligned import check_aligned, check_retarget
from flashdex.motions.checks.recording import (
    Finding,
    check_company,
    check_demo,
    check_sides,
    make_strict,
    status_of,
)
from flashdex.motions.contact.fingertips import NO_OBJECT
from flashdex.motions.contact.support import support_disks
from flashdex.motions.library import NUM_OBJECT_SLOTS
from flashdex.motions.library_writer import MotionRecord
from flashdex.motions.retarget.penetration import (
    make_reference_scene,
    measure_penetration,
)
from flashdex.motions.retarget.residuals import RetargetWeights, Targets
from flashdex.motions.retarget.solver import Retargeter
from flashdex.motions.retarget.starts import Choice, choose_attempt
from flashdex.motions.retarget.targets import _park, make_targets
from flashdex.objects.asset import (
    ObjectAsset,
    ObjectSettings,
    default_cache_dir,
    make_object,
    make_slot_grid,
)
from flashdex.objects.meshes import hull_vertices


@dataclass(frozen=True)
class MotionSettings:
    """How motions are prepared.

    Args:
        hand: robot hand.
        control_hz: frames a second of the references.
        objects: how meshes become objects.
        weights: of the retargeting.
        attempts: of the inverse kinematics at most; the best one is kept.
        cut: cut recordings where contact begins and ends: ``auto`` cuts sessions and
            what lasts too long, ``never`` takes every recording as it is.
        speed: of playback; 0.5 makes every motion last twice as long.
        strict: reject what would be flagged.
        cache_dir: of prepared objects and motions; the user's cache by default.
    """

    hand: str = "xhand"
    control_hz: float = 60.0
    objects: ObjectSettings = field(default_factory=ObjectSettings)
    weights: RetargetWeights = field(default_factory=RetargetWeights)
    attempts: int = 6
    cut: Literal["auto", "always", "never"] = "auto"
    speed: float = 1.0
    strict: bool = False
    cache_dir: Path | None = None

    @property
    def cache_root(self) -> Path:
        """Folder of the cache."""
        return self.cache_dir or default_cache_dir()

    def facts(self) -> dict[str, Any]:
        """All that decides the result: everything but the place of the cache."""
        chosen = asdict(self)
        chosen.pop("cache_dir")
        return chosen

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        if not self.control_hz > 0 or not self.speed > 0:
            raise DemoError(
                f"control rate {self.control_hz:g} and speed {self.speed:g} must be "
                f"positive (--hz, --speed)."
            )


@dataclass
class Prepared:
    """Outcome of one motion: its record unless rejected, and its row of the report."""

    record: MotionRecord | None
    row: dict[str, Any]


def prepare_motion(
    demo: HumanDemo, settings: MotionSettings, findings: list[Finding] | None = None
) -> Prepared:
    """Prepare one motion; a fault of the recording becomes a rejected row.

    Args:
        demo: the recording.
        settings: how.
        findings: remarks from earlier steps.
    """
    row: dict[str, Any] = {"motion": demo.name}
    findings = list(findings or [])
    record = None
    try:
        demo.validate()
        findings += check_demo(demo) + check_sides(demo)
        if status_of(findings) != "rejected":
            record = _prepare(demo, settings, findings, row)
    except (DemoError, MeshError) as error:
        other = "E_MESH" if isinstance(error, MeshError) else "E_DEMO"
        findings.append(Finding(error.code or other, "reject", error.text))
    if settings.strict:
        findings = make_strict(findings)
    row["source"], row["split"], row["task"] = demo.source, demo.split, demo.task
    row["status"] = status_of(findings)
    row["reason"] = reason_of(findings)
    if row["status"] == "rejected" or record is None:
        return Prepared(None, row)
    record.info |= {"status": row["status"], "reason": row["reason"]}
    return Prepared(record, row)


def reject(name: str, findings: list[Finding]) -> Prepared:
    """A motion, or a whole recording, that is not prepared at all."""
    row = {"motion": name, "status": "rejected", "reason": reason_of(findings)}
    return Prepared(None, row)


def reason_of(findings: list[Finding]) -> str:
    """Findings as the report shows them."""
    return "; ".join(f"{f.code}: {f.text}" for f in findings)


def _prepare(
    demo: HumanDemo, settings: MotionSettings, findings: list[Finding], row: dict
) -> MotionRecord | None:
    aligned = align(demo, control_hz=settings.control_hz)
    assets = [
        make_object(m, settings=settings.objects, cache_dir=settings.cache_dir, name=n)
        for m, n in zip(aligned.meshes, aligned.object_names, strict=True)
    ]
    early, figures = check_aligned(
        aligned, assets, make_slot_grid(assets, solid=False), up=demo.up
    )
    findings += early + check_company(aligned)
    row |= figures
    if status_of(findings) == "rejected":
        return None
    specs = load_hand(settings.hand)
    choice, targets = _retarget(aligned, assets, specs, settings)
    best = choice.best
    ranges = np.stack([specs["left"].joint_range, specs["right"].joint_range])
    late, figures = check_retarget(
        aligned, best.joint_pos, best.tip_error, best.depth, ranges
    )
    findings += late
    row |= figures
    return _record(demo, aligned, assets, choice, targets)


def _retarget(
    aligned: AlignedDemo,
    assets: list[ObjectAsset],
    specs: Mapping[Side, HandSpec],
    settings: MotionSettings,
) -> tuple[Choice, Targets]:
    targets = make_targets(aligned, HandModel(specs))
    scene = make_reference_scene(specs, [a.parts for a in assets])
    acting = np.flatnonzero(aligned.active)
    used: dict[Side, HandSpec] = {SIDES[h]: specs[SIDES[h]] for h in acting}
    choice = choose_attempt(
        Retargeter(used, weights=settings.weights),
        targets.of(torch.tensor(acting)),
        make_slot_grid(assets, solid=True),
        count=settings.attempts,
        park=partial(_park, acting=acting),
        measure=partial(
            measure_penetration, scene, poses=aligned.poses, active=aligned.active
        ),
    )
    return choice, targets


def _record(
    demo: HumanDemo,
    aligned: AlignedDemo,
    assets: list[ObjectAsset],
    choice: Choice,
    targets: Targets,
) -> MotionRecord:
    vertices = [hull_vertices(m) for m in aligned.meshes]
    left, right = map(bool, aligned.active)
    left_slot, right_slot = map(int, aligned.hand_object)
    best = choice.best
    return MotionRecord(
        name=demo.name,
        frames=make_frames(aligned, best.joint_pos, targets),
        hand_active=(left, right),
        hand_object=(left_slot, right_slot),
        objects=assets,
        support_disks=support_disks(aligned.poses, vertices, aligned.fps),
        info={
            "source": demo.source,
            "licence": demo.licence,
            "split": demo.split,
            "task": demo.task,
            "source_fps": demo.fps / demo.provenance.get("speed", 1.0),
            "objects": aligned.object_names,
            "support_z": aligned.support_z,
            "attempt_scores_m": choice.scores,
            "provenance": demo.provenance,
        },
        quality={
            "tip_error": _both(best.tip_error, aligned.active),
            "penetration": best.depth.objects.astype(np.float32),
            "contact": aligned.contact,
        },
    )


def _both(values: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Values of the hands that take part, zero for the others, (T, 2, ...)."""
    out = np.zeros((len(values), 2, *values.shape[2:]), dtype=np.float32)
    out[:, active] = values
    return out


def make_frames(
    aligned: AlignedDemo, joint_pos: np.ndarray, targets: Targets
) -> dict[str, np.ndarray]:
    """All per-frame entries of the library, float32."""
    fps, frames = aligned.fps, aligned.num_frames
    poses = np.zeros((frames, NUM_OBJECT_SLOTS, 7))
    poses[..., 3] = 1.0
    for slot, pose in enumerate(aligned.poses):
        poses[:, slot] = pose
    wrist_quat = targets.wrist_quat.numpy()
    turns = [angular_velocity(wrist_quat[:, h], fps) for h in range(2)]
    spins = [angular_velocity(poses[:, s, 3:], fps) for s in range(NUM_OBJECT_SLOTS)]
    tip_dist = np.where(aligned.active[:, None], aligned.tip_dist, NO_OBJECT)
    entries = {
        "joint_pos": joint_pos,
        "joint_vel": linear_velocity(joint_pos, fps),
        "wrist_pos": aligned.keypoints[:, :, 0],
        "wrist_quat": wrist_quat,
        "wrist_linvel": linear_velocity(aligned.keypoints[:, :, 0], fps),
        "wrist_angvel": np.stack(turns, axis=1),
        "keypoints": aligned.keypoints,
        "keypoint_linvel": linear_velocity(aligned.keypoints, fps),
        "tip_dist": tip_dist,
        "object_pos": poses[..., :3],
        "object_quat": poses[..., 3:],
        "object_linvel": linear_velocity(poses[..., :3], fps),
        "object_angvel": np.stack(spins, axis=1),
    }
    return {k: v.astype(np.float32) for k, v in entries.items()}
