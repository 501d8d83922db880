"""MuJoCo C on a thread pool: the engine of laptops, tests and certificates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.envs.physics.base import WrenchFn
from flashdex.envs.scene import Scene, build_scenes, parked_joint_pos
from flashdex.geometry.rotation import quat_rotate, quat_rotate_inverse
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.recipe import PhysicsConfig

_BAD = [
    int(w)
    for w in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]


class CpuPhysics:
    """``mujoco.batch`` with one model a motion.

    Args:
        library: the prepared collection; one scene is compiled for each motion.
        hands: hand specs by side.
        physics: engine settings of the recipe.
        num_envs: worlds N.
    """

    def __init__(
        self,
        library: MotionLibrary,
        hands: dict[keys.Side, HandSpec],
        physics: PhysicsConfig,
        num_envs: int,
    ) -> None:
        self.num_envs = num_envs
        self.decimation = physics.decimation
        self.step_dt = physics.timestep * physics.decimation
        self.scenes: list[Scene] = build_scenes(library, hands, physics)
        self.layout = layout = self.scenes[0].layout
        self.num_slots = library.motions["object_index"].shape[1]
        scene = self.scenes[0]
        self.batch = Batch(scene.model, nsim=num_envs, nthread=physics.num_threads)
        self._models = [scene.model] * num_envs
        self.batch.set_models(self._models)
        self._sides = [keys.SIDES.index(s) for s in layout.sides]
        self._qpos_adr = np.stack([scene.joint_qpos(s) for s in layout.sides])
        self._dof_adr = np.stack([scene.joint_dof(s) for s in layout.sides])
        self._ctrl_adr = np.stack([scene.joint_actuator(s) for s in layout.sides])
        slots = range(layout.num_objects)
        self._obj_qpos = np.array([scene.object_qpos(s) for s in slots])[:, None]
        self._obj_qpos = self._obj_qpos + np.arange(7)
        self._obj_dof = np.array([scene.object_dof(s) for s in slots])[:, None]
        self._obj_dof = self._obj_dof + np.arange(6)
        self._obj_body = [scene.model.body(f"object{s}").id for s in slots]
        self._sensor_adr = np.stack([scene.contact_sensor(s) for s in layout.sides])
        self._parked = np.stack([parked_joint_pos(hands[s]) for s in keys.SIDES])
        self.num_joints = self._parked.shape[1]
        self.num_links = self._sensor_adr.shape[1]
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._xfrc = self.batch.bind("xfrc_applied")
        self._sensor = self.batch.bind("sensordata")
        self._active = library.motions["hand_active"].bool().numpy()
        self._has_object = (library.motions["object_index"] >= 0).numpy()
        self._motion = np.zeros(num_envs, dtype=np.int64)
        self._bad_before = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self,
        env_ids: Tensor,
        motion: Tensor,
        joint_pos: Tensor,
        joint_vel: Tensor,
        object_pose: Tensor,
        object_vel: Tensor,
    ) -> None:
        """Put worlds into given states; see ``Physics.reset``."""
        ids = env_ids.cpu().numpy()
        if ids.size == 0:
            return
        rows = motion.cpu().numpy()
        self._motion[ids] = rows
        self._set_models(ids, rows)
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        active = self._active[rows]
        qpos = np.where(active[..., None], joint_pos.double().numpy(), self._parked)
        qvel = np.where(active[..., None], joint_vel.double().numpy(), 0.0)
        for i, side in enumerate(self._sides):
            self._qpos[ids[:, None], self._qpos_adr[i]] = qpos[:, side]
            self._qvel[ids[:, None], self._dof_adr[i]] = qvel[:, side]
            self._ctrl[ids[:, None], self._ctrl_adr[i]] = qpos[:, side]
        self._write_objects(ids, rows, object_pose, object_vel)
        self.batch.forward(ids=ids)
        self._bad_before[ids] = self._bad_count()[ids]

    def _set_models(self, ids: np.ndarray, rows: np.ndarray) -> None:
        before = list(self._models)
        for env, row in zip(ids.tolist(), rows.tolist(), strict=True):
            self._models[env] = self.scenes[row].model
        if any(a is not b for a, b in zip(before, self._models, strict=True)):
            self.batch.set_models(self._models)

    def step(self, target: Tensor, wrench: WrenchFn | None = None) -> None:
        """Advance one control step; see ``Physics.step``."""
        active = self._active[self._motion][..., None]
        ctrl = np.where(active, target.double().numpy(), self._parked)
        for i, side in enumerate(self._sides):
            self._ctrl[:, self._ctrl_adr[i]] = ctrl[:, side]
        if wrench is None:
            self._xfrc[:] = 0.0
            self.batch.step(nstep=self.decimation)
            return
        for _ in range(self.decimation):
            pose, vel = self._objects()
            applied = wrench(pose, vel).double().numpy()
            for slot, body in enumerate(self._obj_body):
                self._xfrc[:, body] = applied[:, slot]
            self.batch.step(nstep=1)

    def state(self) -> TensorDict:
        """Current state in the layout of ``flashdex.keys``; see ``Physics.state``."""
        n = self.num_envs
        joint_pos = np.zeros((n, 2, self.num_joints), np.float32)
        joint_vel = np.zeros_like(joint_pos)
        contact = np.zeros((n, 2, self.num_links, 6), np.float32)
        for i, side in enumerate(self._sides):
            joint_pos[:, side] = self._qpos[:, self._qpos_adr[i]]
            joint_vel[:, side] = self._qvel[:, self._dof_adr[i]]
            contact[:, side] = self._sensor[:, self._sensor_adr[i]]
        active = self._active[self._motion]
        joint_pos *= active[..., None]
        joint_vel *= active[..., None]
        contact *= active[..., None, None]
        pose, vel = self._objects()
        out = {
            keys.JOINT_POS: torch.from_numpy(joint_pos),
            keys.JOINT_VEL: torch.from_numpy(joint_vel),
            keys.OBJECT_POSE: pose,
            keys.OBJECT_VEL: vel,
            keys.CONTACT: torch.from_numpy(contact),
            "bad": torch.from_numpy(self._bad_count() > self._bad_before),
        }
        return TensorDict(out, batch_size=[n])

    def raw_state(self, env: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Full-precision qpos, qvel and ctrl of one world, for stored rollouts."""
        return self._qpos[env].copy(), self._qvel[env].copy(), self._ctrl[env].copy()

    def applied_wrench(self, env: int) -> np.ndarray:
        """Force and torque on each object slot in the last substep, (O, 6)."""
        out = np.zeros((self.num_slots, 6))
        for slot, body in enumerate(self._obj_body):
            out[slot] = self._xfrc[env, body]
        return out

    def scene(self, env: int) -> Scene:
        """Scene that world ``env`` runs at present."""
        return self.scenes[int(self._motion[env])]

    def _bad_count(self) -> np.ndarray:
        # Columns of the last axis: last info, count.
        return self.batch.warning[:, _BAD, 1].sum(-1).astype(np.int64)

    def _objects(self) -> tuple[Tensor, Tensor]:
        n, used = self.num_envs, self.layout.num_objects
        pose = torch.zeros(n, self.num_slots, 7)
        pose[..., 3] = 1.0
        vel = torch.zeros(n, self.num_slots, 6)
        if used:
            has = torch.from_numpy(self._has_object[self._motion][:, :used, None])
            raw = torch.from_numpy(self._qpos[:, self._obj_qpos]).float()
            raw_vel = torch.from_numpy(self._qvel[:, self._obj_dof]).float()
            pose[:, :used] = torch.where(has, raw, pose[:, :used])
            # MuJoCo keeps the spin of a free joint in body axes.
            spin = quat_rotate(raw[..., 3:], raw_vel[..., 3:])
            raw_vel = torch.cat([raw_vel[..., :3], spin], -1)
            vel[:, :used] = torch.where(has, raw_vel, vel[:, :used])
        return pose, vel

    def _write_objects(
        self, ids: np.ndarray, rows: np.ndarray, pose: Tensor, vel: Tensor
    ) -> None:
        for slot in range(self.layout.num_objects):
            has = self._has_object[rows, slot][:, None]
            empty = np.array([0.0, 0.0, -5.0 - slot, 1.0, 0.0, 0.0, 0.0])
            spin = quat_rotate_inverse(pose[:, slot, 3:], vel[:, slot, 3:])
            dof = torch.cat([vel[:, slot, :3], spin], -1).double().numpy()
            qpos = np.where(has, pose[:, slot].double().numpy(), empty)
            self._qpos[ids[:, None], self._obj_qpos[slot]] = qpos
            self._qvel[ids[:, None], self._obj_dof[slot]] = np.where(has, dof, 0.0)
