"""From an episode of an attempt world to the rollout that is scored and stored."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

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


class RolloutBuilder:
    """Builds rollouts from recorded episodes, on the cpu.

    Args:
        bank: reference frames, on the cpu.
        hands: hand specs by side.
        scenes: scene of each motion.
        decimation: physics substeps of a control step.
        criterion: what the rollouts are stored for.
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
        self.bank, self.scenes, self.hand = bank, scenes, hands["left"].name
        self.kinematics = HandKinematics(hands)
        self.decimation, self.criterion, self.seed = decimation, criterion, seed
        self.made_by = json.dumps(made_by)
        self.provenance = json.dumps(provenance or {})
        both = [hands[side] for side in keys.SIDES]
        pairs = [[*hand.level1_links, *hand.distal_links] for hand in both]
        # (2, M): links, and the row of each one's human keypoint
        self._links = torch.tensor([[link for link, _ in row] for row in pairs])
        order = [
            [hand.keypoint_links.index(pair) for pair in row]
            for hand, row in zip(both, pairs, strict=True)
        ]
        self._keypoints = torch.tensor(order)
        names = [
            [hand.link_names[link] for link, _ in row]
            for hand, row in zip(both, pairs, strict=True)
        ]
        self._bodies = json.dumps(names)

    def build(self, episode: Episode) -> Rollout:
        """The rollout that an episode of an attempt world was."""
        bank, motion = self.bank, episode.motion
        scene = self.scenes[motion]
        qpos = episode.steps["qpos"].astype(np.float64)
        rows = torch.full((len(qpos),), motion)
        frames = torch.arange(episode.frame - len(qpos), episode.frame) + 1
        ref = bank.at(rows, frames)
        ref_links = bank.at(rows, frames, ("link_pos",))["link_pos"]
        kin = self._kinematics(scene, qpos)
        hand = torch.arange(2).unsqueeze(-1)
        has, slot = bank.has_object[motion], bank.hand_slot[motion]
        rollout = Rollout(
            motion=bank.names[motion],
            hand=self.hand,
            fps=bank.fps,
            decimation=self.decimation,
            grace=grace_steps(bank.fps),
            qpos0=episode.qpos0.astype(np.float64),
            qvel0=episode.qvel0.astype(np.float64),
            ctrl=episode.steps["ctrl"].astype(np.float64),
            qpos=qpos,
            qvel=episode.steps["qvel"].astype(np.float64),
            **_objects(scene, qpos, (bank.object_index[motion] >= 0).tolist()),
            ref_object_pos=ref["object_pos"].double().numpy(),
            ref_object_quat=ref["object_quat"].double().numpy(),
            fingertips=kin["tip_pos"].double().numpy(),
            ref_fingertips=ref["tip_pos"].double().numpy(),
            joints=kin["link_pos"][:, hand, self._links].double().numpy(),
            ref_joints=ref_links[:, hand, self._keypoints].double().numpy(),
            hand_active=bank.hand_active[motion].numpy(),
            hand_object=torch.where(has, slot, -1).numpy(),
            joint_bodies=self._bodies,
            model_xml=scene.xml,
            criterion=self.criterion,
            errors="{}",
            versions=self.made_by,
            seed=self.seed,
            env_steps=episode.env_steps,
            actions=episode.steps["action"],
            num_ref_frames=int(bank.length[motion]) - 1,
            wrench=episode.steps["wrench"].astype(np.float64),
            provenance=self.provenance,
        )
        rollout.terminations = [
            {"cause": name, "hand": side}
            for name, blamed in episode.causes.items()
            for side, is_blamed in zip(keys.SIDES, blamed, strict=True)
            if is_blamed
        ]
        return rollout

    def _kinematics(self, scene: Scene, qpos: np.ndarray) -> TensorDictBase:
        joints = np.zeros((len(qpos), 2, self.bank.num_joints), np.float32)
        for side in scene.layout.sides:
            joints[:, keys.SIDES.index(side)] = qpos[:, scene.joint_qpos(side)]
        return self.kinematics(torch.from_numpy(joints), None)


def _objects(scene: Scene, qpos: np.ndarray, present: list[bool]) -> dict[str, Any]:
    """Poses of the object slots, and where they lie in qpos and qvel (-1: nowhere)."""
    slots = len(present)
    pose = np.zeros((len(qpos), slots, 7))
    pose[..., 3] = 1.0
    qpos_adr, dof_adr = np.full(slots, -1), np.full(slots, -1)
    for slot in range(scene.layout.num_objects):
        adr = scene.object_qpos(slot)
        pose[:, slot] = qpos[:, adr : adr + 7]
        if present[slot]:
            qpos_adr[slot], dof_adr[slot] = adr, scene.object_dof(slot)
    return {
        "object_pos": pose[..., :3],
        "object_quat": pose[..., 3:],
        "object_qpos_adr": qpos_adr,
        "object_qvel_adr": dof_adr,
    }
