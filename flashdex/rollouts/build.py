"""From a recorded episode of an attempt world to a storable rollout."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.scene import Scene
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec
from flashdex.rollouts.recorder import Episode
from flashdex.rollouts.rollout import Rollout

GRACE_S = 0.25  # s; 15 steps at 60 Hz, as the criteria define it


def grace_steps(fps: float) -> int:
    """Unscored first steps at a control rate, 15 at 60 Hz."""
    return round(GRACE_S * fps)


@dataclass
class Attempt:
    """One finished episode of an attempt world.

    Attributes:
        rollout: everything the episode consisted of.
        motion: motion row.
        completed: reached the end of the motion without failure.
        why: termination and hand that ended it, empty when completed.
        frame: last frame it was scored on.
    """

    rollout: Rollout
    motion: int
    completed: bool
    why: list[dict[str, str]]
    frame: int


class AttemptMaker:
    """Turns recorded episodes into storable rollouts, on the cpu.

    Args:
        bank: reference frames, on the cpu.
        hands: hand specs by side.
        scenes: scene of each motion.
        decimation: physics substeps of a control step.
        criterion: what the rollouts are judged by.
        seed: of the run.
        made_by: engine, versions and hardware, from ``versions``.
        provenance: hashes of recipe and library, date; stored with every rollout.
    """

    def __init__(
        self,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
        scenes: list[Scene],
        *,
        decimation: int,
        criterion: str,
        seed: int,
        made_by: dict[str, Any],
        provenance: dict[str, str] | None = None,
    ) -> None:
        self.bank, self.hands, self.scenes = bank, hands, scenes
        self.kinematics = HandKinematics(hands)
        self.decimation, self.criterion, self.seed = decimation, criterion, seed
        self.made_by = json.dumps(made_by)
        self.provenance = json.dumps(provenance or {})

    def make(self, episode: Episode) -> Attempt:
        """Return the attempt that an episode of an attempt world was."""
        why = [
            {"cause": name, "hand": side}
            for name, blamed in episode.causes.items()
            for side, is_blamed in zip(keys.SIDES, blamed, strict=True)
            if is_blamed
        ]
        rollout = self._rollout(episode)
        # A time-out before the end of the motion is no failure, but not complete.
        ended = episode.frame >= self._length(episode.motion) - 1
        complete = not why and ended
        return Attempt(rollout, episode.motion, complete, why, episode.frame)

    def _length(self, motion: int) -> int:
        return int(self.bank.length[motion])

    def _rollout(self, episode: Episode) -> Rollout:
        bank, motion = self.bank, episode.motion
        scene = self.scenes[motion]
        qpos = episode.steps["qpos"].astype(np.float64)
        steps = len(qpos)
        rows = torch.full((steps,), motion)
        # Episodes of attempt worlds start at frame 0, so step t is scored on t + 1.
        frames = torch.arange(1, steps + 1)
        ref = bank.at(rows, frames)
        kin = self._kinematics(scene, qpos)
        joints, ref_joints, bodies = self._joints(kin, rows, frames)
        has, slot = bank.has_object[motion], bank.hand_slot[motion]
        objects = _objects(scene, qpos, (bank.object_index[motion] >= 0).tolist())
        return Rollout(
            motion=bank.names[motion],
            hand=self.hands["left"].name,
            fps=bank.fps,
            decimation=self.decimation,
            grace=grace_steps(bank.fps),
            qpos0=episode.qpos0.astype(np.float64),
            qvel0=episode.qvel0.astype(np.float64),
            ctrl=episode.steps["ctrl"].astype(np.float64),
            qpos=qpos,
            qvel=episode.steps["qvel"].astype(np.float64),
            object_pos=objects["pos"],
            object_quat=objects["quat"],
            object_qpos_adr=objects["qpos_adr"],
            object_qvel_adr=objects["qvel_adr"],
            ref_object_pos=_float64(ref, "object_pos"),
            ref_object_quat=_float64(ref, "object_quat"),
            fingertips=_float64(kin, "tip_pos"),
            ref_fingertips=_float64(ref, "tip_pos"),
            joints=joints,
            ref_joints=ref_joints,
            hand_active=bank.hand_active[motion].numpy(),
            hand_object=torch.where(has, slot, -1).numpy(),
            joint_bodies=json.dumps(bodies),
            model_xml=scene.xml,
            criterion=self.criterion,
            errors="{}",
            versions=self.made_by,
            seed=self.seed,
            env_steps=episode.env_steps,
            actions=episode.steps["action"],
            num_ref_frames=self._length(motion) - 1,
            wrench=episode.steps["wrench"].astype(np.float64),
            provenance=self.provenance,
        )

    def _kinematics(self, scene: Scene, qpos: np.ndarray) -> TensorDictBase:
        joints = np.zeros((len(qpos), 2, self.bank.num_joints), np.float32)
        for side in scene.layout.sides:
            joints[:, keys.SIDES.index(side)] = qpos[:, scene.joint_qpos(side)]
        return self.kinematics(torch.from_numpy(joints), None)

    def _joints(
        self, kin: TensorDictBase, rows: Tensor, frames: Tensor
    ) -> tuple[np.ndarray, np.ndarray, list[list[str]]]:
        """Level-1 and distal links, their human keypoints, and the body names."""
        ref = self.bank.at(rows, frames, ("link_pos",))["link_pos"]
        ours, theirs, bodies = [], [], []
        for i, side in enumerate(keys.SIDES):
            hand = self.hands[side]
            pairs = [*hand.level1_links, *hand.distal_links]
            order = [hand.keypoint_links.index(p) for p in pairs]
            links = [link for link, _ in pairs]
            ours.append(kin["link_pos"][:, i, links].double().numpy())
            theirs.append(ref[:, i, order].double().numpy())
            bodies.append([hand.link_names[link] for link in links])
        return np.stack(ours, 1), np.stack(theirs, 1), bodies


def _objects(
    scene: Scene, qpos: np.ndarray, present: list[bool]
) -> dict[str, np.ndarray]:
    """Poses of all object slots, and where they lie in qpos and qvel (-1: nowhere).

    Args:
        scene: of the motion.
        qpos: (T, nq).
        present: which slots hold an object.
    """
    slots, used = len(present), scene.layout.num_objects
    pose = np.zeros((len(qpos), slots, 7))
    pose[..., 3] = 1.0
    qpos_adr, dof_adr = [-1] * slots, [-1] * slots
    for slot in range(used):
        adr = scene.object_qpos(slot)
        pose[:, slot] = qpos[:, adr : adr + 7]
        if present[slot]:
            qpos_adr[slot], dof_adr[slot] = adr, scene.object_dof(slot)
    return {
        "pos": pose[..., :3],
        "quat": pose[..., 3:],
        "qpos_adr": np.array(qpos_adr),
        "qvel_adr": np.array(dof_adr),
    }


def _float64(td: TensorDictBase, key: str) -> np.ndarray:
    return np.asarray(td[key], dtype=np.float64)
