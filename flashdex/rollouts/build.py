"""From an episode of an attempt world to the rollout that is scored and stored."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.scene import Scene
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec
from flashdex.rollouts.recorder import Episode
from flashdex.rollouts.rollout import Rollout, bindings_of

GRACE_S = 0.25  # s; 15 steps at 60 Hz, as the criteria define it


def grace_steps(fps: float) -> int:
    """Unscored first steps at a control rate, 15 at 60 Hz."""
    return round(GRACE_S * fps)


def link_names(hands: dict[keys.Side, HandSpec]) -> str:
    """Names of the bodies behind ``joints`` of a rollout, JSON, both hands."""
    return json.dumps(
        [
            [hand.link_names[i] for i, _ in [*hand.level1_links, *hand.distal_links]]
            for hand in (hands[side] for side in keys.SIDES)
        ]
    )


class RolloutBuilder:
    """Builds rollouts from recorded episodes, on the CPU, where ``bank`` must be.

    ``scenes`` has one a motion; ``made_by`` and ``provenance`` (hashes of recipe and
    library, date, physics settings) are stored with every rollout; ``motion_hash``
    gives the hash of a motion by its row.
    """

    def __init__(
        self,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
        scenes: Sequence[Scene] | Mapping[int, Scene],
        *,
        decimation: int,
        criterion: str,
        seed: int,
        made_by: dict[str, Any],
        provenance: dict[str, Any] | None = None,
        motion_hash: Callable[[int], str] | None = None,
    ) -> None:
        self.bank, self.scenes = bank, scenes
        self._provenance, self._motion_hash = provenance or {}, motion_hash
        self.kinematics = HandKinematics(hands)
        links, keypoints = [], []
        for side in keys.SIDES:
            hand = hands[side]
            pairs = [*hand.level1_links, *hand.distal_links]
            links.append([link for link, _ in pairs])
            keypoints.append([hand.keypoint_links.index(pair) for pair in pairs])
        # (2, M): links of ``joints``, and the rows of their human keypoints
        self._links, self._keypoints = torch.tensor(links), torch.tensor(keypoints)
        self._of_run: dict[str, Any] = {
            "hand": hands["left"].name,
            "fps": bank.fps,
            "decimation": decimation,
            "grace": grace_steps(bank.fps),
            "criterion": criterion,
            "versions": json.dumps(made_by),
            "seed": seed,
            "joint_bodies": link_names(hands),
        }

    def build(self, episode: Episode) -> Rollout:
        """The rollout that an episode of an attempt world was."""
        bank, motion = self.bank, episode.motion
        scene = self.scenes[motion]
        steps = {name: _float64(rows) for name, rows in episode.steps.items()}
        qpos = steps["qpos"]
        rows = torch.full((len(qpos),), motion)
        frames = torch.arange(episode.frame - len(qpos), episode.frame) + 1
        ref = bank.at(rows, frames)
        ref_links = bank.at(rows, frames, ("link_pos",))["link_pos"]
        kin = self.kinematics(self._hand_joints(scene, qpos), None)
        hand = torch.arange(2).unsqueeze(-1)
        has, slot = bank.has_object[motion], bank.hand_slot[motion]
        rollout = Rollout(
            **self._of_run,
            motion=bank.names[motion],
            qpos0=_float64(episode.qpos0),
            qvel0=_float64(episode.qvel0),
            ctrl=steps["ctrl"],
            qpos=qpos,
            qvel=steps["qvel"],
            wrench=steps["wrench"],
            actions=episode.steps["action"],
            **_objects(scene, qpos, (bank.object_index[motion] >= 0).tolist()),
            ref_object_pos=_float64(ref["object_pos"]),
            ref_object_quat=_float64(ref["object_quat"]),
            fingertips=_float64(kin["tip_pos"]),
            ref_fingertips=_float64(ref["tip_pos"]),
            joints=_float64(kin["link_pos"][:, hand, self._links]),
            ref_joints=_float64(ref_links[:, hand, self._keypoints]),
            hand_active=bank.hand_active[motion].numpy(),
            hand_object=torch.where(has, slot, -1).numpy(),
            model_xml=scene.xml,
            errors="{}",
            env_steps=episode.env_steps,
            num_ref_frames=int(bank.length[motion]) - 1,
        )
        bound = bindings_of(rollout)
        if self._motion_hash is not None:
            bound["motion_sha256"] = self._motion_hash(motion)
        rollout.provenance = json.dumps({**self._provenance, **bound})
        rollout.terminations = [
            {"cause": name, "hand": side}
            for name, blamed in episode.causes.items()
            for side, is_blamed in zip(keys.SIDES, blamed, strict=True)
            if is_blamed
        ]
        return rollout

    def _hand_joints(self, scene: Scene, qpos: np.ndarray) -> torch.Tensor:
        joints = np.zeros((len(qpos), 2, self.bank.num_joints), np.float32)
        for side in scene.layout.sides:
            joints[:, keys.SIDES.index(side)] = qpos[:, scene.joint_qpos(side)]
        return torch.from_numpy(joints)


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


def _float64(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float64)
