"""Who plays controls in worlds: MuJoCo C, or MuJoCo Warp with thousands at once."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from flashdex.search.config import SampleEngine

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.warp.rollout import WarpRollout

_LOG = logging.getLogger(__name__)
# kept on a device: samples and finalists, with and without more effort, in one world
# and in several; at the end of a motion the horizon alone differs
BATCHES = 6
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS

Array = NDArray[np.float64]
Played = tuple[NDArray[Any], NDArray[Any]]  # in the engine's own precision


@dataclass(frozen=True)
class Worlds:
    """Where sequences of actions are tried: the nominal world first, K in all."""

    models: list[mujoco.MjModel]
    states: Array  # full physics states, (K, .)
    noise: Array  # added to the controls of the whole motion, (K, S, nu)

    def after(self, states: Array) -> Worlds:
        """The same worlds in other states, (K, .)."""
        return Worlds(self.models, states, self.noise)

    def only(self, which: slice) -> Worlds:
        """Some of the worlds."""
        return Worlds(self.models[which], self.states[which], self.noise[which])


class Simulator(Protocol):
    """Plays N sequences of H controls in each of K worlds."""

    def __call__(self, worlds: Worlds, ctrl: Array, first: int) -> Played:
        """Play controls (N, H, nu) from the worlds' states, at control step ``first``.

        Returns:
            Full physics states after each control step and the sensors of its last
            substep, (N, K, H, .).
        """
        ...


class MujocoC:
    """MuJoCo C in the calling thread, for the worlds of one scene."""

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        self._data, self._substeps = mujoco.MjData(model), substeps

    def __call__(self, worlds: Worlds, ctrl: Array, first: int) -> Played:
        """Play controls; see ``Simulator``."""
        n, steps = ctrl.shape[:2]
        count, substeps = len(worlds.models), self._substeps
        ctrl = ctrl[:, None] + worlds.noise[None, :, first : first + steps]
        ctrl = np.repeat(ctrl.reshape(n * count, steps, -1), substeps, axis=1)
        models = worlds.models[0] if count == 1 else worlds.models * n
        start = np.tile(worlds.states, (n, 1))
        states, sensors = (
            x[:, substeps - 1 :: substeps].reshape(n, count, steps, x.shape[-1])
            for x in rollout.rollout(models, self._data, start, ctrl)
        )
        return states, sensors


class Warp:
    """MuJoCo Warp; the worlds it was last asked for stay on the device.

    Raises:
        MissingExtraError: warp is not installed.
    """

    def __init__(self, physics: PhysicsConfig) -> None:
        from flashdex.envs.physics.warp.model import require_warp

        require_warp()
        self._physics = physics
        self._batches: dict[tuple[int, ...], WarpRollout] = {}
        self._most = sys.maxsize  # worlds that there is room for

    def __call__(self, worlds: Worlds, ctrl: Array, first: int) -> Played:
        """Play controls, as many sequences at a time as fit; see ``Simulator``."""
        batch = self._batch_for(worlds.models, len(ctrl))
        noise = worlds.noise[:, first : first + ctrl.shape[1]]
        starts = range(0, len(ctrl), batch.count)
        parts = [ctrl[i : i + batch.count] for i in starts]
        short = batch.count - len(parts[-1])
        parts[-1] = np.pad(parts[-1], ((0, short), (0, 0), (0, 0)), mode="edge")
        played = [batch(worlds.states, part, noise) for part in parts]
        states, sensors = (np.concatenate(found) for found in zip(*played, strict=True))
        return states[: len(ctrl)], sensors[: len(ctrl)]

    def _batch_for(self, models: list[mujoco.MjModel], count: int) -> WarpRollout:
        from flashdex.envs.physics.warp.rollout import NoRoomError, WarpRollout

        while True:
            size = max(1, min(count, self._most // len(models)))
            key = (size, *map(id, models))  # a batch keeps its models, and their ids
            if batch := self._batches.get(key):
                return batch
            if len(self._batches) >= BATCHES:
                self._batches.clear()
            try:
                self._batches[key] = WarpRollout(models, size, self._physics)
            except NoRoomError as error:
                if self._batches:  # their memory may be enough
                    self._batches.clear()
                    continue
                if size == 1:
                    raise
                self._most = size * len(models) // 2
                _LOG.warning("%s; %d at a time", error, self._most)

    @property
    def overflow(self) -> dict[str, int]:
        """Worlds on the device that have run out of room, by kind."""
        return dict(
            sum((Counter(b.overflow) for b in self._batches.values()), Counter())
        )


def make_simulator(engine: SampleEngine, physics: PhysicsConfig) -> Simulator | None:
    """What tries samples; None is MuJoCo C, which a problem has of its own.

    Raises:
        MissingExtraError: packages of the engine are not installed.
    """
    return Warp(physics) if engine == "warp" else None
