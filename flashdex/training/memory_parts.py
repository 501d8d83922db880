"""The parts of a training run that take memory, each with its bytes."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from functools import cached_property

import mujoco
import torch
from mujoco.batch import Batch

from flashdex.envs.physics.warp.memory import WarpMemory, measure_warp
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.scene import build_scenes
from flashdex.hands.spec import load_hand
from flashdex.recipe import Recipe
from flashdex.rollouts.recorder import LOOK_EVERY
from flashdex.system.machine import Pool
from flashdex.training.memory_learner import LearnerSizes
from flashdex.training.memory_library import (
    STAND_IN_FRAMES,
    STAND_IN_MOTIONS,
    STAND_IN_OBJECTS,
    Collection,
    stand_in,
)
from flashdex.training.memory_walk import tensor_bytes

# Allowances: what no arithmetic gives. On the GPU the contexts of torch and warp, their
# kernels and workspaces, and gaps between blocks; on the host the same libraries.
GPU_ALLOWANCE, HOST_ALLOWANCE = 3 << 29, 1 << 30


# Parts that do not depend on what a collection holds.
CERTAIN = {"replay rows", "stored replay rows", "CUDA", "libraries"}


@dataclass(frozen=True)
class Part:
    """One line of the plan.

    Attributes:
        name: what it is.
        pool: where it lies.
        size: bytes.
        detail: the product it is.
        assumed: worst case of a collection that is not prepared yet.
    """

    name: str
    pool: Pool
    size: int
    detail: str
    assumed: bool = False


class PartSizes:
    """Sizes of a recipe's parts a row, a world, a frame; products make the plan.

    Args:
        recipe: validated recipe; buffer, batch and worlds play no role here.
        sizes: of its collection.
    """

    def __init__(self, recipe: Recipe, sizes: Collection) -> None:
        self.recipe, self.collection = recipe, sizes
        self.hands = load_hand(recipe.hand)
        joints = self.hands["left"].num_joints
        self.library = stand_in(sizes, joints=joints, hand=recipe.hand)
        self.bank = ReferenceBank(self.library, self.hands)
        self.learner = LearnerSizes(recipe.algo, recipe.env, self.bank, self.hands)

    @cached_property
    def bank_bytes(self) -> tuple[int, int]:
        """Reference frames, and objects (points, distance grids, masses)."""
        counts = self.collection
        scale = {
            STAND_IN_FRAMES: counts.frames,
            STAND_IN_MOTIONS: counts.motions,
            STAND_IN_OBJECTS: counts.objects,
        }
        per_frame = per_object = 0
        for buffer in self.bank.buffers():
            rows = len(buffer)
            size = tensor_bytes(buffer) * scale.get(rows, rows) // rows
            if rows == STAND_IN_OBJECTS:
                per_object += size
            else:
                per_frame += size
        return per_frame, per_object

    @cached_property
    def model(self) -> mujoco.MjModel:
        """Scene of a stand-in motion: as many joints, bodies and geoms as any."""
        return build_scenes(self.library, self.hands, self.recipe.physics)[0].model

    @cached_property
    def cpu(self) -> tuple[int, int]:
        """mujoco.batch: bytes a world, and a thread."""
        batch = Batch(self.model, nsim=1, nthread=1)
        world = batch.nstate * 8 + batch.bind("sensordata").nbytes
        world += batch.warning.nbytes
        data = mujoco.MjData(self.model)
        return world, data.nbuffer + data.narena

    @cached_property
    def warp(self) -> WarpMemory:
        """mujoco_warp's arrays."""
        return measure_warp(self.library, self.hands, self.recipe.physics)

    def ring_bytes(self, recipe: Recipe, *, device: Pool) -> int:
        """`flashdex.rollouts.recorder`: the last steps of the attempt worlds.

        Args:
            recipe: worlds, episode length and engine.
            device: where they live.
        """
        number = 8 if recipe.physics.engine == "cpu" else 4  # bytes, of the physics
        model, env = self.model, recipe.env
        slots, joints = self.collection.slots, self.bank.num_joints
        states = 2 * (model.nq + model.nv) + model.nu
        flags = 1 + 2 * sum(v is not None for v in env.terminations.values())
        step = states * number + 4 * (6 * slots + 2 * joints) + 2 * 8 + flags
        dt = recipe.physics.timestep * recipe.physics.decimation
        longest = min(self.collection.longest - 1, round(env.max_seconds / dt))
        longest += LOOK_EVERY if device == "gpu" else 1
        return round(env.attempt_share * env.num_envs) * longest * step


def list_parts(recipe: Recipe, sizes: PartSizes, *, device: Pool) -> list[Part]:
    """Everything a run of the recipe allocates that is worth a line.

    Args:
        recipe: validated recipe.
        sizes: of a recipe that differs in buffer, batch, worlds and replay only.
        device: where the learner lives.
    """
    parts = [*_learner(recipe, sizes, device), *_physics(recipe, sizes, device)]
    frames, objects = sizes.bank_bytes
    counts = sizes.collection
    unknown = not counts.known
    about = f"{counts.frames:,} frames of {counts.motions} motions"
    parts += [
        Part("reference frames", device, frames, about),
        Part(
            "objects",
            device,
            objects,
            f"{counts.objects} x {counts.points} points, {counts.nodes}^3 distances",
        ),
    ]
    if device == "gpu":
        copy = "for storing rollouts"
        whole = frames + objects
        parts.append(Part("references on the host", "host", whole, copy))
        parts.append(Part("CUDA", "gpu", GPU_ALLOWANCE, "allowance, not computed"))
    parts.append(Part("libraries", "host", HOST_ALLOWANCE, "allowance, not computed"))
    parts += _disk(recipe, sizes)
    return [
        dataclasses.replace(p, assumed=unknown and p.name not in CERTAIN) for p in parts
    ]


def engine_pool(recipe: Recipe, device: Pool) -> Pool:
    """Where the physics is: a GPU engine takes a GPU also beside a learner on the host.

    Args:
        recipe: its engine.
        device: where the learner lives.
    """
    if recipe.physics.engine == "cpu":
        return "host"
    return "gpu" if torch.cuda.is_available() else device


def _learner(recipe: Recipe, sizes: PartSizes, device: Pool) -> list[Part]:
    algo, learner = recipe.algo, sizes.learner
    nets = learner.networks
    about = (
        f"weights {nets.weights / 1e6:,.0f}, gradients {nets.gradients / 1e6:,.0f}, "
        f"Adam {nets.moments / 1e6:,.0f} MB"
    )
    parts = [Part("networks", device, nets.total, about)]
    envs, count = recipe.env.num_envs, max(1, math.ceil(algo.updates_per_step))
    if algo.kind == "ppo":
        return [*parts, *_rollout(recipe, sizes, device)]
    size = algo.batch_size
    rows = 2 * count * size + envs
    tail = algo.n_step * envs * learner.step_bytes
    place = replay_pool(recipe, device)
    return [
        Part(
            "replay rows",
            place,
            algo.buffer_size * learner.row_bytes,
            f"{algo.buffer_size:,} x {learner.row_bytes} B",
        ),
        *parts,
        Part(
            "update",
            device,
            learner.update_bytes(size),
            f"batch and activations of {size} rows, walked",
        ),
        Part(
            "observations",
            device,
            rows * learner.assembled_bytes,
            f"{rows:,} x {learner.assembled_bytes:,} B while assembled",
        ),
        Part("n-step window", device, tail, f"{algo.n_step} steps of {envs} worlds"),
    ]


def replay_pool(recipe: Recipe, device: Pool) -> Pool:
    """Where the replay rows lie: with the learner, or in host memory."""
    return device if recipe.algo.replay in ("auto", "device") else "host"


def _rollout(recipe: Recipe, sizes: PartSizes, device: Pool) -> list[Part]:
    algo, learner = recipe.algo, sizes.learner
    rows = recipe.env.num_envs * algo.ppo.horizon
    window = 0 if learner.future is None else math.prod(learner.future)
    shown = 4 * (learner.observation + window)
    # collected and stacked; raw inputs, scaled inputs and the groups' copies
    size = rows * (
        2 * learner.step_bytes + (2 + len(sizes.learner.groups.names)) * shown
    )
    share = -(-rows // algo.ppo.minibatches)
    about = f"{rows:,} rows of {algo.ppo.horizon} steps, with their inputs"
    return [
        Part("rollout", device, size, about),
        Part(
            "update",
            device,
            learner.update_bytes(share),
            f"minibatch and activations of {share:,} rows, walked",
        ),
    ]


def _physics(recipe: Recipe, sizes: PartSizes, device: Pool) -> list[Part]:
    engine, envs = recipe.physics.engine, recipe.env.num_envs
    device = engine_pool(recipe, device)
    counts = sizes.collection
    scene = mujoco.mj_sizeModel(sizes.model)
    parts = [
        Part(
            "scenes",
            "host",
            counts.motions * scene,
            f"{counts.motions} models x {scene:,} B",
        ),
    ]
    ring = sizes.ring_bytes(recipe, device=device)
    parts.append(Part("attempts", device, ring, "last steps of the attempt worlds"))
    if engine == "cpu":
        threads = recipe.physics.num_threads or _cores()
        world, thread = sizes.cpu
        size, about = (
            envs * world + threads * thread,
            f"{envs} worlds x {world:,} B, {threads} threads x {thread:,} B",
        )
        return [*parts, Part("physics", "host", size, about)]
    if engine == "warp":
        warp = sizes.warp
        size = warp.fixed + envs * warp.per_world
        about = (
            f"{envs} worlds x {warp.per_world:,} B with room for "
            f"{warp.room.contacts} contacts, {warp.room.rows} constraint rows"
        )
        return [*parts, Part("physics", device, size, about)]
    about = "brax: not computed, JAX reserves memory by its own settings"
    return [*parts, Part("physics", device, 0, about)]


def _disk(recipe: Recipe, sizes: PartSizes) -> list[Part]:
    train, algo, nets = recipe.train, recipe.algo, sizes.learner.networks
    one, kept = nets.weights + nets.moments, train.keep_checkpoints + 1
    about = f"{kept} x {one / 1e6:,.0f} MB, one of them being written"
    parts = [Part("checkpoints", "disk", kept * one, about)]
    if train.checkpoint_replay and algo.kind != "ppo":
        rows = min(algo.buffer_size, recipe.total_env_steps)
        size = rows * sizes.learner.row_bytes
        about = f"{rows:,} x {sizes.learner.row_bytes} B"
        parts.append(Part("stored replay rows", "disk", size, about))
    return parts


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
