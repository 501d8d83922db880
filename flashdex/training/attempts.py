"""Records attempt worlds, so that a finished episode becomes a storable rollout."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.tracking import TrackingEnv
from flashdex.metrics.rollout import Rollout

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


@dataclass
class _Track:
    """Open recording of one world."""

    qpos0: np.ndarray
    qvel0: np.ndarray
    qpos: list[np.ndarray] = field(default_factory=list)
    qvel: list[np.ndarray] = field(default_factory=list)
    ctrl: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    wrench: list[np.ndarray] = field(default_factory=list)


class AttemptRecorder:
    """Follows the attempt worlds of an environment, step by step.

    Call ``begin`` after resets and ``step`` after each environment step, before the
    reset that follows it.

    Args:
        env: the environment, on the CPU engine.
        criterion: what the rollouts are judged by.
        seed: of the run.
        provenance: hashes of recipe and library, date; stored with every rollout.
    """

    def __init__(
        self,
        env: TrackingEnv,
        *,
        criterion: str,
        seed: int,
        provenance: dict[str, str] | None = None,
    ) -> None:
        if not isinstance(env.physics, CpuPhysics):
            msg = "attempts are recorded on the cpu engine only"
            raise TypeError(msg)
        self.env, self.physics = env, env.physics
        self.criterion, self.seed = criterion, seed
        self.provenance = json.dumps(provenance or {})
        self._tracks: dict[int, _Track] = {}

    def begin(self, env_ids: Tensor) -> None:
        """Start recordings of the attempt worlds among ``env_ids``."""
        for env in env_ids.tolist():
            if self.env.attempt[env]:
                qpos, qvel, _ = self.physics.raw_state(env)
                self._tracks[env] = _Track(qpos, qvel)

    def step(
        self, action: Tensor, next_td: TensorDictBase, env_steps: int
    ) -> list[Attempt]:
        """Record one step; return the attempts that it finished.

        Args:
            action: (N, 2, J).
            next_td: ``next`` entry of the step.
            env_steps: counter of the run.
        """
        finished = []
        done = next_td[keys.DONE].squeeze(-1)
        for env, track in self._tracks.items():
            qpos, qvel, ctrl = self.physics.raw_state(env)
            track.qpos.append(qpos)
            track.qvel.append(qvel)
            track.ctrl.append(ctrl)
            track.wrench.append(self.physics.applied_wrench(env))
            track.actions.append(action[env].numpy().copy())
            if done[env]:
                finished.append(self._finish(env, track, env_steps))
        for env in done.nonzero().squeeze(-1).tolist():
            self._tracks.pop(env, None)
        return finished

    def _finish(self, env: int, track: _Track, env_steps: int) -> Attempt:
        info = self.env.info
        assert info is not None
        motion = int(info.motion[env])
        why = [
            {"cause": name, "hand": side}
            for name, mask in info.outcome.causes.items()
            for i, side in enumerate(keys.SIDES)
            if mask[env, i]
        ]
        rollout = self._rollout(env, track, motion, env_steps)
        frame = int(info.frame[env])
        # A time-out before the end of the motion is no failure, but not complete.
        ended = frame >= int(self.env.bank.length[motion]) - 1
        return Attempt(rollout, motion, not why and ended, why, frame)

    def _rollout(self, env: int, track: _Track, motion: int, env_steps: int) -> Rollout:
        physics, bank = self.physics, self.env.bank
        scene = physics.scene(env)
        qpos, qvel = np.stack(track.qpos), np.stack(track.qvel)
        steps = len(qpos)
        rows = torch.full((steps,), motion)
        # Episodes of attempt worlds start at frame 0, so step t is scored on t + 1.
        frames = torch.arange(1, steps + 1)
        ref = bank.at(rows, frames)
        joint_pos = np.zeros((steps, 2, bank.num_joints), np.float32)
        for side in scene.layout.sides:
            joint_pos[:, keys.SIDES.index(side)] = qpos[:, scene.joint_qpos(side)]
        kin = self.env.kinematics(torch.from_numpy(joint_pos), None)
        index = scene.layout.num_objects
        adr = [scene.object_qpos(s) for s in range(index)]
        present = (bank.object_index[motion] >= 0).tolist()
        slots = bank.num_slots
        pose = np.zeros((steps, slots, 7))
        pose[..., 3] = 1.0
        for slot in range(index):
            pose[:, slot] = qpos[:, adr[slot] : adr[slot] + 7]
        qpos_adr = [adr[s] if s < index and present[s] else -1 for s in range(slots)]
        dof_adr = [
            scene.object_dof(s) if qpos_adr[s] >= 0 else -1 for s in range(slots)
        ]
        joints, ref_joints, bodies = self._joints(kin, rows, frames)
        slot_of_hand = torch.where(
            bank.has_object[motion], bank.hand_slot[motion], torch.tensor(-1)
        )
        fps = 1.0 / self.env.step_dt
        return Rollout(
            motion=bank.names[motion],
            hand=self.env.hands["left"].name,
            fps=fps,
            decimation=physics.decimation,
            grace=grace_steps(fps),
            qpos0=track.qpos0,
            qvel0=track.qvel0,
            ctrl=np.stack(track.ctrl),
            qpos=qpos,
            qvel=qvel,
            object_pos=pose[..., :3],
            object_quat=pose[..., 3:],
            ref_object_pos=_float64(ref, "object_pos"),
            ref_object_quat=_float64(ref, "object_quat"),
            fingertips=_float64(kin, "tip_pos"),
            ref_fingertips=_float64(ref, "tip_pos"),
            joints=joints,
            ref_joints=ref_joints,
            hand_active=bank.hand_active[motion].numpy(),
            hand_object=slot_of_hand.numpy(),
            object_qpos_adr=np.array(qpos_adr),
            object_qvel_adr=np.array(dof_adr),
            joint_bodies=json.dumps(bodies),
            model_xml=scene.xml,
            criterion=self.criterion,
            errors="{}",
            versions=json.dumps(versions()),
            seed=self.seed,
            env_steps=env_steps,
            actions=np.stack(track.actions),
            num_ref_frames=int(bank.length[motion]) - 1,
            wrench=np.stack(track.wrench),
            provenance=self.provenance,
        )

    def _joints(
        self, kin: TensorDictBase, rows: Tensor, frames: Tensor
    ) -> tuple[np.ndarray, np.ndarray, list[list[str]]]:
        """Level-1 and distal links, their human keypoints, and the body names."""
        ref = self.env.bank.at(rows, frames, ("link_pos",))["link_pos"]
        ours, theirs, bodies = [], [], []
        for i, side in enumerate(keys.SIDES):
            hand = self.env.hands[side]
            pairs = [*hand.level1_links, *hand.distal_links]
            order = [hand.keypoint_links.index(p) for p in pairs]
            links = [link for link, _ in pairs]
            ours.append(kin["link_pos"][:, i, links].double().numpy())
            theirs.append(ref[:, i, order].double().numpy())
            bodies.append([hand.link_names[link] for link in links])
        return np.stack(ours, 1), np.stack(theirs, 1), bodies


def _float64(td: TensorDictBase, key: str) -> np.ndarray:
    return np.asarray(td[key], dtype=np.float64)


def versions(engine: str = "cpu") -> dict[str, Any]:
    """Package versions, engine and hardware that produce a rollout.

    Args:
        engine: physics engine of the recipe.
    """
    names = ("flashdex", "torch", "torchrl", "tensordict")
    found: dict[str, Any] = {}
    for name in names:
        try:
            found[name] = version(name)
        except ModuleNotFoundError:
            found[name] = "source"
    return {
        **found,
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        "engine": engine,
        "hardware": f"{platform.machine()}, {os.cpu_count()} CPU cores",
    }
