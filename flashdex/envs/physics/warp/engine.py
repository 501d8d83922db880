"""mujoco_warp: all worlds on one GPU, each with the objects of its own motion."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.envs.physics.base import Physics, RawState
from flashdex.envs.physics.warp.model import (
    WorldRows,
    model_fields,
    require_warp,
    room_of,
    warp_device,
)
from flashdex.envs.physics.warp.wrench import WrenchInput
from flashdex.envs.scene.scene import Scene
from flashdex.envs.scene.union import build_union
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

_log = logging.getLogger(__name__)


class Recorded:
    """A function of warp launches on fixed arrays, replayed from its second call on.

    The first call runs as it is, which compiles the kernels; the second records it, as
    a CUDA graph or as warp's list of launches on the CPU. Where that fails the function
    goes on as it is, with one warning. ``launch`` does nothing but launch kernels.
    """

    def __init__(self, launch: Callable[[], None], device: torch.device) -> None:
        self._launch = launch
        self._device = device
        self._name = str(require_warp()[0].device_from_torch(device))
        self._calls = 0
        self._graph: Any = None

    def __call__(self) -> None:
        """Run it after all work that torch has queued so far, before all later work."""
        wp = require_warp()[0]
        if self._calls == 1:
            self._graph = self._record()
        self._calls += 1
        stream = None  # the CPU has none
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        if self._graph is not None:
            wp.capture_launch(self._graph, stream=stream)
            return
        with wp.ScopedDevice(self._name), wp.ScopedStream(stream):
            self._launch()

    def _record(self) -> Any:
        wp = require_warp()[0]
        # Torch's default stream cannot be recorded: this one only serves to record.
        own = wp.Stream(self._name) if self._device.type == "cuda" else None
        try:
            with (
                wp.ScopedDevice(self._name),
                wp.ScopedStream(own),
                wp.ScopedCapture(device=self._name, stream=own) as capture,
            ):
                self._launch()
        except Exception as error:
            _log.warning(
                "physics.engine=warp: the step could not be recorded and runs launch "
                "by launch, which is slower: %s",
                error,
            )
            return None
        return capture.graph


def _kinds(overflow: Any) -> dict[str, int]:
    """Bits of warp's overflow flags by what ran out; iteration limits are no room."""
    return {
        "contacts": overflow.BROADPHASE | overflow.NARROWPHASE | overflow.CCD,
        "contact shapes": overflow.EPA_HORIZON,
        "constraints": overflow.NEFC | overflow.NJMAX_NNZ,
        "contact sensors": overflow.CONTACT_MATCH,
    }


def count_overflow(flags: Tensor) -> dict[str, int]:
    """Worlds that ran out of room, by kind, of warp's flags (N,), which are cleared."""
    mjw = require_warp()[1]
    found = flags.clone()
    flags.zero_()
    worlds = {
        kind: int(((found & int(bits)) != 0).sum())
        for kind, bits in _kinds(mjw.OverflowType).items()
    }
    return {kind: count for kind, count in worlds.items() if count}


class WarpPhysics(Physics):
    """One model of mujoco_warp whose rows follow each world's motion; see ``Physics``.

    It computes in float32 and runs on the first CUDA device, without one on the CPU.

    Raises:
        FlashdexError: its packages are missing, or it cannot run this collection.
    """

    def __init__(
        self,
        library: MotionLibrary,
        hands: dict[keys.Side, HandSpec],
        physics: PhysicsConfig,
        num_envs: int,
        scenes: list[Scene] | None = None,
    ) -> None:
        wp = require_warp()[0]
        super().__init__(library, hands, physics, num_envs, warp_device(), scenes)
        union = build_union(library, hands, physics, self.scenes, model_fields())
        room = room_of(union.model, physics)
        name = str(wp.device_from_torch(self.device))
        self._rows = WorldRows(union, num_envs, room, name)
        self.model, self.data = self._rows.model, self._rows.data
        self._contact_adr = torch.as_tensor(union.contact).to(self.device)
        data = self.data
        self._qpos, self._qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self._ctrl, self._xfrc = wp.to_torch(data.ctrl), wp.to_torch(data.xfrc_applied)
        self._sensor = wp.to_torch(data.sensordata)
        self._warmstart = wp.to_torch(data.qacc_warmstart)
        self._overflow = wp.to_torch(data.overflow)
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._wrench = WrenchInput(self.data, union.model, self.map, num_envs)
        self._bad_wp = wp.from_torch(self._bad)
        self._step_free = Recorded(self._launch_free, self.device)
        self._step_pulled = Recorded(self._launch_pulled, self.device)
        self._forward = Recorded(self._launch_forward, self.device)
        self._rows.write(torch.ones_like(self._bad), self._motion)

    def _place(self, mask: Tensor, *state: Tensor) -> None:
        self._rows.write(mask, self._motion)
        chosen = mask.unsqueeze(-1)
        views = (self._qpos, self._qvel, self._ctrl)
        flat = self.map.write(self._motion, *state)
        for view, value in zip(views, flat, strict=True):
            view.copy_(torch.where(chosen, value.float(), view))
        for view in (self._warmstart, self._xfrc, self._wrench.applied):
            held = mask.reshape(-1, *[1] * (view.ndim - 1))
            view.copy_(torch.where(held, 0.0, view))
        # Of the other worlds this changes only what a step computes anew, and what
        # the sensors said of their last substep, and the solver's first guess.
        sensed, guess = self._sensor.clone(), self._warmstart.clone()
        self._forward()
        self._sensor.copy_(torch.where(chosen, self._sensor, sensed))
        self._warmstart.copy_(torch.where(chosen, self._warmstart, guess))
        self._bad &= ~mask

    def step(self, target: Tensor, wrench: ObjectWrench | None = None) -> None:
        """Advance one control step; see ``Physics.step``."""
        self._ctrl.copy_(self.map.controls(self._motion, target))
        if wrench is None:
            self._xfrc.zero_()
            self._wrench.applied.zero_()
            self._step_free()
        else:
            self._wrench.copy(wrench)
            self._step_pulled()

    def state(self) -> TensorDict:
        """Current state in the layout of ``flashdex.keys``; see ``Physics.state``."""
        adr = self._contact_adr[self._motion]
        sensed = self._sensor.gather(1, adr.flatten(1)).reshape(adr.shape)
        found = self._state(self._qpos, self._qvel, sensed, self._bad.clone())
        return found.to(self.device)

    def raw(self) -> RawState:
        """Views of the state; see ``Physics.raw``."""
        return RawState(self._qpos, self._qvel, self._ctrl, self._wrench.applied)

    def take_overflow(self) -> dict[str, int]:
        """Worlds whose room was too small since the last call; see ``Physics``."""
        return count_overflow(self._overflow)

    def _launch_free(self) -> None:
        for _ in range(self.decimation):
            self._launch_substep()

    def _launch_pulled(self) -> None:
        for _ in range(self.decimation):
            self._wrench.launch()
            self._launch_substep()

    def _launch_substep(self) -> None:
        wp, mjw = require_warp()
        from flashdex.envs.physics.warp.kernels import mark_bad

        mjw.step(self.model, self.data)
        arrays = [self.data.qpos, self.data.qvel, self.data.qacc]
        wp.launch(
            mark_bad,
            dim=self.num_envs,
            inputs=arrays,
            outputs=[self._bad_wp],
            device=self.data.qpos.device,
        )

    def _launch_forward(self) -> None:
        require_warp()[1].forward(self.model, self.data)
