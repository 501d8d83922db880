"""What the library stores of a motion, made of its reference."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.demo import HumanDemo
from flashdex.datasets.tracks import angular_velocity, linear_velocity
from flashdex.motions.contact.roles import NO_OBJECT, Interaction
from flashdex.motions.contact.support import support_disks
from flashdex.motions.library_format import NUM_OBJECT_SLOTS
from flashdex.motions.library_writer import MotionRecord
from flashdex.motions.retarget.solver import Choice
from flashdex.motions.retarget.targets import Targets
from flashdex.objects.asset import ObjectAsset
from flashdex.objects.meshes import hull_vertices


def make_record(
    demo: HumanDemo,
    motion: Interaction,
    assets: list[ObjectAsset],
    choice: Choice,
    targets: Targets,
) -> MotionRecord:
    """A motion as it goes into the library."""
    vertices = [hull_vertices(m) for m in motion.meshes]
    left, right = map(bool, motion.active)
    left_slot, right_slot = map(int, motion.hand_object)
    best = choice.best
    tip_error = np.zeros((motion.num_frames, 2, 5), dtype=np.float32)
    tip_error[:, motion.active] = best.tip_error
    return MotionRecord(
        name=demo.name,
        frames=_make_frames(motion, best.joint_pos, targets),
        hand_active=(left, right),
        hand_object=(left_slot, right_slot),
        objects=assets,
        support_disks=support_disks(motion.poses, vertices, motion.fps),
        info={
            "source": demo.source,
            "licence": demo.licence,
            "split": demo.split,
            "task": demo.task,
            "source_fps": demo.fps / demo.provenance.get("speed", 1.0),
            "objects": motion.object_names,
            "support_z": motion.support_z,
            "attempt_scores_m": choice.scores,
            "provenance": demo.provenance,
        },
        quality={
            "tip_error": tip_error,
            "penetration": best.depth.objects.astype(np.float32),
            "contact": motion.contact,
        },
    )


def _make_frames(
    motion: Interaction, joint_pos: np.ndarray, targets: Targets
) -> dict[str, np.ndarray]:
    """All per-frame entries of the library, float32."""
    fps, wrist_pos = motion.fps, motion.keypoints[:, :, 0]
    poses = np.zeros((motion.num_frames, NUM_OBJECT_SLOTS, 7))
    poses[..., 3] = 1.0
    for slot, pose in enumerate(motion.poses):
        poses[:, slot] = pose
    wrist_quat = targets.wrist_quat.numpy()
    turns = [angular_velocity(wrist_quat[:, h], fps) for h in range(2)]
    spins = [angular_velocity(poses[:, s, 3:], fps) for s in range(NUM_OBJECT_SLOTS)]
    entries = {
        "joint_pos": joint_pos,
        "joint_vel": linear_velocity(joint_pos, fps),
        "wrist_pos": wrist_pos,
        "wrist_quat": wrist_quat,
        "wrist_linvel": linear_velocity(wrist_pos, fps),
        "wrist_angvel": np.stack(turns, axis=1),
        "keypoints": motion.keypoints,
        "keypoint_linvel": linear_velocity(motion.keypoints, fps),
        "tip_dist": np.where(motion.active[:, None], motion.tip_dist, NO_OBJECT),
        "object_pos": poses[..., :3],
        "object_quat": poses[..., 3:],
        "object_linvel": linear_velocity(poses[..., :3], fps),
        "object_angvel": np.stack(spins, axis=1),
    }
    return {k: v.astype(np.float32) for k, v in entries.items()}
