"""Records attempt worlds, so that a finished episode becomes a storable rollout."""

from __future__ import annotations

import json
import os
import platform
from collections import deque
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.scene import Scene
from flashdex.envs.tracking import TrackingEnv
from flashdex.metrics.rollout import Rollout
from flashdex.training.attempt_ring import AttemptRing, Episode

LOOK_EVERY = 16  # steps; each look waits for the device once
ENGINE_PACKAGES = {
    "warp": ("mujoco-warp", "warp-lang"),
    "brax": ("mujoco-mjx", "jax", "brax"),
}
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


class AttemptRecorder:
    """Follows the attempt worlds of an environment, step by step.

    Call ``begin`` after resets and ``step`` after each environment step, before the
    reset that follows it.

    Args:
        env: the environment.
        criterion: what the rollouts are judged by.
        seed: of the run.
        engine: physics engine, stored with the rollouts.
        provenance: hashes of recipe and library, date; stored with every rollout.
        look_every: steps between two looks for finished episodes; every step on the
            cpu, every ``LOOK_EVERY`` on a device when None.
    """

    def __init__(
        self,
        env: TrackingEnv,
        *,
        criterion: str,
        seed: int,
        engine: str = "cpu",
        provenance: dict[str, str] | None = None,
        look_every: int | None = None,
    ) -> None:
        self.env, self.criterion, self.seed = env, criterion, seed
        self.provenance = json.dumps(provenance or {})
        self.versions = json.dumps(versions(engine, env.device))
        if look_every is None:
            look_every = 1 if env.device.type == "cpu" else LOOK_EVERY
        self.ring = AttemptRing(env, look_every=look_every)
        self._env_steps: deque[int] = deque(maxlen=look_every)

    def begin(self) -> None:
        """Keep the states after a reset; those of worlds that go on change nothing."""
        self.ring.begin()

    def step(
        self, action: Tensor, next_td: TensorDictBase, env_steps: int
    ) -> list[Attempt]:
        """Record one step; return attempts that are known to be finished.

        Args:
            action: (N, 2, J).
            next_td: ``next`` entry of the step.
            env_steps: counter of the run.
        """
        self.ring.step(action, next_td[keys.DONE])
        self._env_steps.append(env_steps)
        return self.flush() if self.ring.due else []

    def flush(self) -> list[Attempt]:
        """Attempts that have finished since the last look; waits for the device."""
        found = self.ring.look()
        behind = self.ring.written - 1  # step of the newest counter
        return [self._finish(e, self._env_steps[-1 - (behind - e.last)]) for e in found]

    def _finish(self, episode: Episode, env_steps: int) -> Attempt:
        why = [
            {"cause": name, "hand": side}
            for name, blamed in episode.causes.items()
            for side, is_blamed in zip(keys.SIDES, blamed, strict=True)
            if is_blamed
        ]
        rollout = self._rollout(episode, env_steps)
        # A time-out before the end of the motion is no failure, but not complete.
        ended = episode.frame >= self._length(episode.motion) - 1
        complete = not why and ended
        return Attempt(rollout, episode.motion, complete, why, episode.frame)

    def _length(self, motion: int) -> int:
        return int(self.env.bank.length[motion])

    def _rollout(self, episode: Episode, env_steps: int) -> Rollout:
        bank, motion = self.env.bank, episode.motion
        scene = self.env.physics.scenes[motion]
        qpos = episode.steps["qpos"].astype(np.float64)
        steps = len(qpos)
        rows = torch.full((steps,), motion, device=self.env.device)
        # Episodes of attempt worlds start at frame 0, so step t is scored on t + 1.
        frames = torch.arange(1, steps + 1, device=self.env.device)
        ref = bank.at(rows, frames)
        kin = self._kinematics(scene, qpos)
        joints, ref_joints, bodies = self._joints(kin, rows, frames)
        has, slot = bank.has_object[motion], bank.hand_slot[motion]
        objects = _objects(scene, qpos, (bank.object_index[motion] >= 0).tolist())
        fps = 1.0 / self.env.step_dt
        return Rollout(
            motion=bank.names[motion],
            hand=self.env.hands["left"].name,
            fps=fps,
            decimation=self.env.physics.decimation,
            grace=grace_steps(fps),
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
            hand_active=bank.hand_active[motion].cpu().numpy(),
            hand_object=torch.where(has, slot, -1).cpu().numpy(),
            joint_bodies=json.dumps(bodies),
            model_xml=scene.xml,
            criterion=self.criterion,
            errors="{}",
            versions=self.versions,
            seed=self.seed,
            env_steps=env_steps,
            actions=episode.steps["action"],
            num_ref_frames=self._length(motion) - 1,
            wrench=episode.steps["wrench"].astype(np.float64),
            provenance=self.provenance,
        )

    def _kinematics(self, scene: Scene, qpos: np.ndarray) -> TensorDictBase:
        joints = np.zeros((len(qpos), 2, self.env.bank.num_joints), np.float32)
        for side in scene.layout.sides:
            joints[:, keys.SIDES.index(side)] = qpos[:, scene.joint_qpos(side)]
        return self.env.kinematics(torch.from_numpy(joints).to(self.env.device), None)

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
            ours.append(kin["link_pos"][:, i, links].double().cpu().numpy())
            theirs.append(ref[:, i, order].double().cpu().numpy())
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
    return np.asarray(td[key].cpu(), dtype=np.float64)


def versions(engine: str = "cpu", device: torch.device | None = None) -> dict[str, Any]:
    """Package versions, engine and hardware that produce a rollout.

    Args:
        engine: physics engine of the recipe.
        device: where it ran; the cpu when None.
    """
    names = ("flashdex", "torch", "torchrl", "tensordict")
    found: dict[str, Any] = {}
    for name in names:
        try:
            found[name] = version(name)
        except ModuleNotFoundError:
            found[name] = "source"
    for name in ENGINE_PACKAGES.get(engine, ()):
        found[name] = version(name)
    hardware = f"{platform.machine()}, {os.cpu_count()} CPU cores"
    if device is not None and device.type == "cuda":
        hardware = f"{torch.cuda.get_device_name(device)}, {hardware}"
    return {
        **found,
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        "engine": engine,
        "hardware": hardware,
    }
