"""Open-loop rollouts: many sequences of controls in variants of one scene, at once."""

from __future__ import annotations

import copy
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flashdex.envs.physics.warp.engine import Recorded, count_overflow
from flashdex.envs.physics.warp.model import (
    model_fields,
    require_warp,
    room_of,
    warp_device,
)
from flashdex.errors import FlashdexError

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

_log = logging.getLogger(__name__)

Array = NDArray[Any]

NO_ROOM = ("memory", "alloc")  # of what Warp and CUDA say where there is none


class NoRoomError(FlashdexError):
    """Worlds that the device has no memory for."""


class WarpRollout:
    """N sequences in each of K variants of a scene, N x K worlds on the device.

    World n K + k has sequence n and variant k. A control step is one recorded graph;
    the host launches H of them and waits once, for the result.

    Args:
        models: the variants; they may differ in numbers that mujoco_warp has per world.
        count: N.
        physics: decimation, and the room for contacts.

    Raises:
        NoRoomError: they do not fit in the device's memory.
        FlashdexError: the variants differ in something else.
    """

    def __init__(
        self, models: list[mujoco.MjModel], count: int, physics: PhysicsConfig
    ) -> None:
        wp, _ = require_warp()
        self.models, self.count = models, count
        self._decimation = physics.decimation
        self.device = warp_device()
        self._name = str(wp.device_from_torch(self.device))
        try:
            self._model, self._data = self._put(physics)
            # of model and data alone: in a circle they would be free too late
            launch = partial(_launch, self._model, self._data, self._decimation)
            self._step = Recorded(launch, self.device)
            self._step()  # asks for the memory of a step
        except (RuntimeError, MemoryError) as error:
            told = str(error).lower()
            if isinstance(error, RuntimeError) and not any(x in told for x in NO_ROOM):
                raise
            raise NoRoomError(
                f"physics=warp: {count * len(models)} worlds do not fit on "
                f"{self._name} ({error})"
            ) from None
        data = self._data
        self._qpos, self._qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self._ctrl, self._sensor = wp.to_torch(data.ctrl), wp.to_torch(data.sensordata)
        self._warmstart = wp.to_torch(data.qacc_warmstart)
        self._overflow = wp.to_torch(data.overflow)
        self._overflow.zero_()  # of that first step
        self.overflow: dict[str, int] = {}  # worlds that ran out of room last, by kind

    def _put(self, physics: PhysicsConfig) -> tuple[Any, Any]:
        """Model and data on the device; what differs between variants has K rows.

        mujoco_warp reads row ``world % K``. The rows are those that mj_setConst left,
        so inverse weights and the like follow from each variant's masses.
        """
        wp, mjw = require_warp()
        rows, worlds = _rows(self.models), self.count * len(self.models)
        host = copy.copy(self.models[0])
        # mujoco_warp never resets a world that diverges, and has no such flag.
        host.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        room = room_of(host, physics)
        with wp.ScopedDevice(self._name):
            lengths = {name: len(values) for name, values in rows.items()}
            model = mjw.put_model(host, batch_sizes=lengths)
            data = mjw.make_data(
                host,
                nworld=worlds,
                nconmax=room.contacts,
                nccdmax=room.convex,
                njmax=room.rows,
            )
        model.opt.warn_overflow = 0  # told below
        wp.synchronize_device(self._name)  # from here on torch writes on its own stream
        for name, values in rows.items():
            view = wp.to_torch(getattr(model, name))
            view.copy_(torch.from_numpy(values).reshape(view.shape))
        return model, data

    def _spread(self, rows: Array) -> Tensor:
        """Rows of the variants (K, .) for all worlds, (N K, .)."""
        found = torch.from_numpy(rows).to(self.device, torch.float32)
        return found.repeat(self.count, *[1] * (found.ndim - 1))

    def __call__(self, states: Array, ctrl: Array, noise: Array) -> tuple[Array, Array]:
        """Play controls from the variants' states, float32.

        Args:
            states: time, qpos and qvel, (K, 1 + nq + nv).
            ctrl: of each sequence, (N, H, nu).
            noise: added to it in each variant, (K, H, nu).

        Returns:
            States after each control step and the sensors of its last substep,
            (N, K, H, .).
        """
        (n, steps), count = ctrl.shape[:2], len(states)
        start = self._spread(states)
        nq, nv = self._qpos.shape[1], self._qvel.shape[1]
        self._qpos.copy_(start[:, 1 : 1 + nq])
        self._qvel.copy_(start[:, 1 + nq :])
        self._warmstart.zero_()
        given = torch.from_numpy(ctrl).to(self.device, torch.float32)
        given = given.repeat_interleave(count, 0) + self._spread(noise)
        found = start.new_empty(steps, n * count, 1 + nq + nv)
        sensors = start.new_empty(steps, *self._sensor.shape)
        dt = self._decimation * self.models[0].opt.timestep
        elapsed = dt * torch.arange(1, steps + 1, device=self.device)
        found[..., 0] = start[:, 0] + elapsed[:, None]
        for t in range(steps):
            self._ctrl.copy_(given[:, t])
            self._step()
            found[t, :, 1 : 1 + nq].copy_(self._qpos)
            found[t, :, 1 + nq :].copy_(self._qvel)
            sensors[t].copy_(self._sensor)
        states, sensed = (
            x.reshape(steps, n, count, -1).permute(1, 2, 0, 3).cpu().numpy()
            for x in (found, sensors)
        )
        self._look_for_overflow()
        return states, sensed

    def _look_for_overflow(self) -> None:
        """Warn, once, where the engine dropped contacts: those samples were wrong."""
        found = count_overflow(self._overflow)
        if found and not self.overflow:
            _log.warning(
                "samples in MuJoCo Warp: of %d worlds some ran out of room (%s), so "
                "they lacked contacts; what is found is scored in MuJoCo C all the "
                "same. Raise physics.nconmax and physics.njmax",
                self.count * len(self.models),
                ", ".join(f"{kind} {count}" for kind, count in found.items()),
            )
        self.overflow = found or self.overflow


def _launch(model: Any, data: Any, substeps: int) -> None:
    step = require_warp()[1].step
    for _ in range(substeps):
        step(model, data)


def _rows(models: list[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """Fields of which the variants have different numbers, (K, ...).

    Raises:
        FlashdexError: mujoco_warp has only one of such a field for all worlds.
    """
    out = {}
    for name, is_per_world in model_fields().items():
        values = [getattr(model, name) for model in models if hasattr(model, name)]
        if all(np.array_equal(value, values[0]) for value in values):
            continue
        if not is_per_world:
            raise FlashdexError(
                f"physics=warp: the worlds of one search differ in {name}, which warp "
                "worlds share. Use physics=cpu."
            )
        out[name] = np.stack([np.array(value) for value in values])
    return out
