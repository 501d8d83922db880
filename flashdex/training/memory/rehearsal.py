"""A run of two worlds: what it holds a row, a world and a frame, and in one update.

The run's own parts are built on the CPU for motions that are made up, step and are
remembered; an update of any size runs on torch's meta device, where tensors have shapes
and no memory. What is allocated is counted.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, cast

import mujoco
import torch

from flashdex import keys
from flashdex.algorithms.footprint import tensor_bytes
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.physics.warp.memory import WarpMemory, measure_warp
from flashdex.envs.reference import ReferenceBank
from flashdex.hands.spec import load_hand
from flashdex.recipe import Recipe
from flashdex.replay.codec import row_bytes
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.training.build import RunBuilder
from flashdex.training.memory.stand_in import Collection, StandIn

_WORLDS, _BATCH = 2, 32


class Rehearsal:
    """Two worlds of a recipe after some steps; products of its sizes make the plan.

    Buffer, batch and worlds of the recipe play no role here.
    """

    def __init__(self, recipe: Recipe, collection: Collection) -> None:
        self.recipe, self.collection = recipe, collection
        self.hands = load_hand(recipe.hand)
        joints = self.hands["left"].num_joints
        self.library = StandIn.of(collection, joints=joints, hand=recipe.hand)
        self.bank = ReferenceBank(self.library, self.hands)
        bench = RunBuilder(_small(recipe), self.library, self.hands, self.bank)
        env = bench.make_env()
        self._batch = cast(CpuPhysics, env.physics).batch
        self.model = env.physics.scenes[0].model
        learner, self._ring = bench.make_learner(env), EpisodeRecorder(env)
        td: Any = env.rand_step(env.reset())
        self._ring.record_start()
        after, action = td["next"], torch.zeros(_WORLDS, 2, joints)
        self._ring.record_step(action, after[keys.DONE], 0)
        flags, reward = (after[keys.TERMINATED], after[keys.DONE]), torch.zeros(2, 2)
        with _quiet(logging.getLogger("torchrl")):  # it tells of its buffer
            for _ in range(recipe.algo.n_step):
                learner.process_step(td, action, reward, after, flags[0], flags[1])
        ends = [list(end.select(*keys.STATE).values(True, True)) for end in (td, after)]
        self.step_bytes = tensor_bytes([ends, action, reward, flags]) // _WORLDS
        """One step of one world before packing: states, action, reward, flags."""
        rows = None if learner.buffer is None else learner.buffer[:]
        self.row_bytes = 0 if rows is None else row_bytes(rows)
        """A packed replay row; 0 where the algorithm keeps none."""
        self.learner = learner.rehearse(recipe.algo, td)

    @cached_property
    def bank_bytes(self) -> tuple[int, int]:
        """Reference frames, and objects (points, distance grids, masses)."""
        return self.library.scale(list(self.bank.buffers()), self.collection)

    @cached_property
    def cpu(self) -> tuple[int, int]:
        """mujoco.batch: bytes a world, and a thread."""
        batch, data = self._batch, mujoco.MjData(self.model)
        derived = batch.bind("sensordata").nbytes + batch.warning.nbytes
        return batch.nstate * 8 + derived // _WORLDS, data.nbuffer + data.narena

    @cached_property
    def warp(self) -> WarpMemory:
        """mujoco_warp's arrays."""
        return measure_warp(self.library, self.hands, self.recipe.physics)

    @cached_property
    def attempt_bytes(self) -> int:
        """One step that is recorded of an attempt world."""
        halved = self.recipe.physics.engine != "cpu"  # only MuJoCo C has float64
        return sum(
            ring[0, 0].numel()
            * (4 if halved and ring.dtype == torch.float64 else ring.element_size())
            for ring in self._ring._rings.values()
        )


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    level = logger.level
    logger.setLevel(logging.WARNING)
    yield
    logger.setLevel(level)


def _small(recipe: Recipe) -> Recipe:
    """Two worlds, one of which attempts, MuJoCo C and the narrowest networks."""
    change = dataclasses.replace
    return change(
        recipe,
        env=change(recipe.env, num_envs=_WORLDS, attempt_share=0.5, compile=False),
        physics=change(recipe.physics, engine="cpu", num_threads=1),
        algo=change(
            recipe.algo,
            device="cpu",
            compile=False,
            replay="device",
            buffer_size=_BATCH,
            batch_size=_BATCH,
            actor_width=8,
            critic_width=8,
        ),
    )
