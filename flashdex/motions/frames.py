"""What the library stores of a motion, made of its reference."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.demo import HumanDemo
from flashdex.motions.contact.roles import NO_OBJECT, Interaction
from flashdex.motions.contact.support import support_disks
from flashdex.motions.library_format import NUM_OBJECT_SLOTS
from flashdex.motions.library_writer import MotionRecord
from flashdex.motions.retarget.solver import Choice
from flashdex.motions.retarget.targets import Targets
from flashdex.motions.velocities import derive_velocities
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
    poses = np.zeros((motion.num_frames, NUM_OBJECT_SLOTS, 7))
    poses[..., 3] = 1.0
    for slot, pose in enumerate(motion.poses):
        poses[:, slot] = pose
    entries = {
        "joint_pos": joint_pos,
        "wrist_pos": motion.keypoints[:, :, 0],
        "wrist_quat": targets.wrist_quat.numpy(),
        "keypoints": motion.keypoints,
        "tip_dist": np.where(motion.active[:, None], motion.tip_dist, NO_OBJECT),
        "object_pos": poses[..., :3],
        "object_quat": poses[..., 3:],
    }
    frames = {k: v.astype(np.float32) for k, v in entries.items()}
    # of what is stored, so that they follow from it to the last digit
    speeds = derive_velocities(frames, motion.fps)
    return frames | {k: v.astype(np.float32) for k, v in speeds.items()}
