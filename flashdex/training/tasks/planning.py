"""A pass of a search over one motion, in a process of its own: plan, score, certify."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.scene.scene import SceneLayout, rebuild_scene
from flashdex.errors import FlashdexError, RunError
from flashdex.recipe import SearchRecipe
from flashdex.rollouts.build import grace_steps
from flashdex.rollouts.certificate import Certificate
from flashdex.rollouts.ledger import prove
from flashdex.rollouts.recorder import Episode
from flashdex.rollouts.rollout import MAX_FILE, Rollout
from flashdex.rollouts.scorer import live_with_parent
from flashdex.search.costs import ErrorLimits, shares
from flashdex.search.plan import Planner
from flashdex.search.problem import Problem
from flashdex.search.simulate import make_simulator
from flashdex.system.arrays import hash_content
from flashdex.training.build import RunBuilder

KEPT = 4  # problems that a worker keeps


@dataclass(frozen=True)
class Order:
    """What a worker is asked for."""

    row: int
    rung: int  # place among the passes of the ladder, then of the robust one
    start: Path | None = None  # rollout to draw around
    start_sha256: str = ""


@dataclass(frozen=True)
class Found:
    """What came of it."""

    order: Order
    rollout: Rollout
    certificate: Certificate | None  # of one that passes
    core_s: float
    simulated: int  # control steps, of all worlds


class Worker:
    """Problems of a recipe's motions, in a process of its own."""

    def __init__(self, recipe: SearchRecipe, provenance: dict[str, str]) -> None:
        self.recipe = recipe
        self.builder = RunBuilder.from_recipe(recipe, device=torch.device("cpu"))
        self.layout = SceneLayout.of(self.builder.library)
        self.limits = ErrorLimits.of(recipe.train.criterion)
        self.simulator = make_simulator(recipe.search.engine, recipe.physics)
        # one that waits for its device spends time as well
        waits = self.simulator is not None
        self.clock = time.perf_counter if waits else time.process_time
        self.provenance = provenance
        self.problem = lru_cache(KEPT)(self._problem)

    def _problem(self, row: int) -> Problem:
        builder, recipe = self.builder, self.recipe
        scene = rebuild_scene(
            builder.library, row, builder.hands, recipe.physics, self.layout, nodes=0
        )
        return Problem(
            builder.bank,
            builder.hands,
            StateMap(builder.library, builder.hands, scene),
            scene,
            row,
            env=recipe.env,
            decimation=recipe.physics.decimation,
            simulator=self.simulator,
        )

    def _start(self, order: Order, problem: Problem) -> NDArray[np.float32] | None:
        """Actions of the rollout that an order names, until its object is lost."""
        path = order.start
        if path is None:
            return None
        if hash_content(path, most=MAX_FILE) != order.start_sha256:
            raise RunError(f"{path}: was changed while the search was at work.")
        rollout = Rollout.load(path)
        ctrl = rollout.ctrl[: problem.steps]
        if ctrl.shape[1] != problem.model.nu or not np.isfinite(ctrl).all():
            raise RunError(f"{path}: holds no controls of this motion's scene.")
        poses = rollout.object_pos, rollout.object_quat
        pos, quat = (x[None, None, : len(ctrl), problem.slots] for x in poses)
        error = shares(pos, quat, problem, 0, self.limits).worst[0, 0]
        near = np.flatnonzero(error <= 1)
        return problem.residuals(ctrl)[: near.max(initial=0) + 1]

    def work(self, order: Order) -> Found:
        """Plan one motion by one rung, score it, and certify what passes."""
        begun, search = self.clock(), self.recipe.search
        problem = self.problem(order.row)
        before = problem.simulated
        plan = Planner(
            problem,
            search,
            search.rungs[order.rung],
            limits=self.limits,
            grace=grace_steps(self.builder.bank.fps),
            seed=[self.recipe.seed, order.row, order.rung],
            start=self._start(order, problem),
        ).run()
        episode = Episode(
            env=0,
            env_steps=0,
            steps=problem.play(plan.actions),
            qpos0=problem.qpos0,
            qvel0=problem.qvel0,
            motion=order.row,
            frame=len(plan.actions),
            causes={} if plan.is_whole else {"given_up": problem.is_active},
        )
        builder = self.builder.rollout_builder(
            {order.row: problem.scene}, provenance=self.provenance
        )
        rollout = builder.build(episode)
        summary = rollout.summary(self.recipe.train.criterion)
        certificate = None
        if summary["converted"] and self.recipe.train.certify:
            rollout.errors = json.dumps(summary["errors"])
            certificate = prove(rollout, problem.scene.model)
        spent = self.clock() - begun
        return Found(order, rollout, certificate, spent, problem.simulated - before)


_worker: list[Worker] = []  # of this process


def open_worker(recipe: SearchRecipe, provenance: dict[str, str]) -> None:
    """First thing in the process."""
    live_with_parent()
    if recipe.search.engine == "cpu":  # a process a core
        torch.set_num_threads(1)
    _worker.append(Worker(recipe, provenance))


def work(order: Order) -> Found:
    """Do what is asked for, in the process that was opened.

    Raises:
        RunError: a start is not what it should be, or the motion's scene is not.
    """
    try:
        return _worker[0].work(order)
    except FlashdexError as error:
        raise RunError(str(error)) from None  # others may not travel between processes
