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
from flashdex.envs.physics.base import Physics, RawState
from flashdex.envs.scene.scene import Scene
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

_BAD = [
    int(w)
    for w in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]
_FULL = {
    "contacts": int(mujoco.mjtWarning.mjWARN_CONTACTFULL),
    "constraints": int(mujoco.mjtWarning.mjWARN_CNSTRFULL),
}


class CpuPhysics(Physics):
    """``mujoco.batch`` with one model a motion; see ``Physics``."""

    def __init__(
        self,
        library: MotionLibrary,
        hands: dict[keys.Side, HandSpec],
        physics: PhysicsConfig,
        num_envs: int,
        scenes: list[Scene] | None = None,
    ) -> None:
        super().__init__(library, hands, physics, num_envs, torch.device("cpu"), scenes)
        scene = self.scenes[0]
        self.layout = layout = scene.layout
        self.batch = Batch(scene.model, nsim=num_envs, nthread=physics.num_threads)
        self._models = [scene.model] * num_envs
        self.batch.set_models(self._models)
        slots = range(layout.num_objects)
        self._obj_body = [scene.model.body(f"object{s}").id for s in slots]
        self._sensor_adr = np.stack([scene.contact_sensor(s) for s in layout.sides])
        self._qpos = torch.from_numpy(self.batch.bind("qpos"))
        self._qvel = torch.from_numpy(self.batch.bind("qvel"))
        self._ctrl = torch.from_numpy(self.batch.bind("ctrl"))
        self._xfrc = self.batch.bind("xfrc_applied")
        self._sensor = self.batch.bind("sensordata")  # read-only: no torch view
        self._wrench = torch.zeros(num_envs, self.map.num_slots, 6)
        self._bad_before = np.zeros(num_envs, dtype=np.int64)
        self._full_before = self._count(list(_FULL.values()))
        self._full = np.zeros((num_envs, len(_FULL)), dtype=bool)

    def _place(self, mask: Tensor, *state: Tensor) -> None:
        rows = mask.nonzero().squeeze(-1)
        ids = rows.numpy()
        if ids.size == 0:
            return
        self._note_overflow()  # the reset forgets it
        self._set_models(ids.tolist())
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        given = (self._motion, *state)
        qpos, qvel, ctrl = self.map.write(*(x[rows] for x in given))
        self._qpos[rows], self._qvel[rows], self._ctrl[rows] = qpos, qvel, ctrl
        self.batch.forward(ids=ids)
        self._bad_before[ids] = self._count(_BAD)[ids].sum(-1)

    def _set_models(self, envs: list[int]) -> None:
        before = list(self._models)
        for env in envs:
            self._models[env] = self.scene(env).model
        if any(a is not b for a, b in zip(before, self._models, strict=True)):
            self.batch.set_models(self._models)

    def step(self, target: Tensor, wrench: ObjectWrench | None = None) -> None:
        """Advance one control step; see ``Physics.step``."""
        self._ctrl[:] = self.map.controls(self._motion, target)
        if wrench is None:
            self._xfrc[:] = 0.0
            self._wrench.zero_()
            self.batch.step(nstep=self.decimation)
            return
        for _ in range(self.decimation):
            self._wrench = wrench(
                *self.map.read_objects(self._qpos, self._qvel, self._motion)
            )
            applied = self._wrench.double().numpy()
            for slot, body in enumerate(self._obj_body):
                self._xfrc[:, body] = applied[:, slot]
            self.batch.step(nstep=1)

    def state(self) -> TensorDict:
        """Current state in the layout of ``flashdex.keys``; see ``Physics.state``."""
        contact = torch.from_numpy(self._sensor[:, self._sensor_adr])
        bad = torch.from_numpy(self._count(_BAD).sum(-1) > self._bad_before)
        return self._state(self._qpos, self._qvel, contact, bad)

    def raw(self) -> RawState:
        """Views of the full-precision state; see ``Physics.raw``."""
        return RawState(self._qpos, self._qvel, self._ctrl, self._wrench)

    def take_overflow(self) -> dict[str, int]:
        """Worlds whose arena was full since the last call; see ``Physics``."""
        self._note_overflow()
        worlds = self._full.sum(0).tolist()
        self._full[:] = False
        return {k: n for k, n in zip(_FULL, worlds, strict=True) if n}

    def scene(self, env: int) -> Scene:
        """Scene that world ``env`` runs at present."""
        return self.scenes[int(self._motion[env])]

    def _note_overflow(self) -> None:
        now = self._count(list(_FULL.values()))
        self._full |= now > self._full_before
        self._full_before = now

    def _count(self, kinds: list[int]) -> np.ndarray:
        # Columns of the last axis: last info, count.
        return self.batch.warning[:, kinds, 1].astype(np.int64)
