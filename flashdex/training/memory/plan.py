"""What memory a recipe needs, whether this machine has it, and what would fit instead.

All of it is known before anything large is allocated: what `Rehearsal` finds of a row,
a world and a frame is multiplied.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import torch

from flashdex.algorithms import find_algorithm
from flashdex.errors import FlashdexError
from flashdex.motions.library import MotionLibrary
from flashdex.recipe import Recipe
from flashdex.rollouts.recorder import LOOK_EVERY
from flashdex.system.machine import Machine, Pool, look_at_machine
from flashdex.training.build import learner_device
from flashdex.training.memory.rehearsal import Rehearsal
from flashdex.training.memory.stand_in import Collection, find_library

_LOG = logging.getLogger(__name__)
TIGHT = 0.9  # share of what is free
POOLS: tuple[Pool, ...] = ("gpu", "host", "disk")
NAMES: dict[Pool, str] = {"gpu": "GPU memory", "host": "host memory", "disk": "disk"}
# Allowances: what no rehearsal gives. On the GPU the contexts of torch and warp, their
# kernels and workspaces, and gaps between blocks; on the host the same libraries.
GPU_ALLOWANCE, HOST_ALLOWANCE = 3 << 29, 1 << 30
# Parts that do not depend on what a collection holds.
CERTAIN = {"replay rows", "stored replay rows", "CUDA", "libraries"}


@dataclass(frozen=True)
class Part:
    """One line of the plan: its bytes, where they lie, the product they are.

    ``assumed`` marks the worst case of a collection that is not prepared yet.
    """

    name: str
    pool: Pool
    size: int
    detail: str
    assumed: bool = False


def list_parts(recipe: Recipe, sizes: Rehearsal, *, device: Pool) -> list[Part]:
    """Everything a run of the recipe allocates that is worth a line.

    ``sizes`` are of a recipe that differs in buffer, batch, worlds and replay only.
    """
    frames, objects = sizes.bank_bytes
    counts = sizes.collection
    about = f"{counts.objects} x {counts.points} points, {counts.nodes}^3 distances"
    allowance = "allowance, not computed"
    parts = [
        *_learner(recipe, sizes, device),
        *_physics(recipe, sizes, device),
        Part(
            "reference frames",
            device,
            frames,
            f"{counts.frames:,} frames of {counts.motions} motions",
        ),
        Part("objects", device, objects, about),
    ]
    if device == "gpu":
        about = "for storing rollouts"
        parts.append(Part("references on the host", "host", frames + objects, about))
        parts.append(Part("CUDA", "gpu", GPU_ALLOWANCE, allowance))
    parts.append(Part("libraries", "host", HOST_ALLOWANCE, allowance))
    return [
        dataclasses.replace(p, assumed=not counts.known and p.name not in CERTAIN)
        for p in parts
    ]


def replay_pool(recipe: Recipe, device: Pool) -> Pool:
    """Where the replay rows lie: with the learner, or in host memory."""
    return device if recipe.algo.replay in ("auto", "device") else "host"


def _learner(recipe: Recipe, sizes: Rehearsal, device: Pool) -> Iterator[Part]:
    algo, train, envs = recipe.algo, recipe.train, recipe.env.num_envs
    nets, width = sizes.learner.networks, sizes.row_bytes
    kind = find_algorithm(algo.kind)
    rows, size = kind.row_count(algo, envs), kind.batch_rows(algo, envs)
    about = (
        f"weights {nets.weights / 1e6:,.0f}, gradients {nets.gradients / 1e6:,.0f}, "
        f"Adam {nets.moments / 1e6:,.0f} MB"
    )
    yield Part("networks", device, nets.total, about)
    if width:
        yield _product("replay rows", replay_pool(recipe, device), rows, width)
        ends = 2 * max(1, math.ceil(algo.updates_per_step)) * size + envs
        each = sizes.learner.input_bytes
        yield _product("observations", device, ends, each, " while assembled")
        about = f"{algo.n_step} steps of {envs} worlds"
        tail = algo.n_step * envs * sizes.step_bytes
        yield Part("n-step window", device, tail, about)
        if train.checkpoint_replay:
            rows = min(rows, recipe.total_env_steps)
            yield _product("stored replay rows", "disk", rows, width)
    elif rows:
        each = 2 * sizes.step_bytes + sizes.learner.input_bytes  # collected and stacked
        about = f" of {rows // envs} steps, with their inputs"
        yield _product("rollout", device, rows, each, about)
    about = f"batch and activations of {size:,} rows, walked"
    yield Part("update", device, sizes.learner.update(size)[0], about)
    one, kept = nets.weights + nets.moments, train.keep_checkpoints + 1
    about = f"{kept} x {one / 1e6:,.0f} MB, one of them being written"
    yield Part("checkpoints", "disk", kept * one, about)


def _product(name: str, pool: Pool, rows: int, each: int, about: str = "") -> Part:
    return Part(name, pool, rows * each, f"{rows:,} x {each:,} B{about}")


def _physics(recipe: Recipe, sizes: Rehearsal, device: Pool) -> Iterator[Part]:
    engine, env, counts = recipe.physics.engine, recipe.env, sizes.collection
    # a GPU engine takes a GPU also beside a learner on the host
    place: Pool = "gpu" if torch.cuda.is_available() else device
    place = "host" if engine == "cpu" else place
    scene = mujoco.mj_sizeModel(sizes.model)
    about = f"{counts.motions} models x {scene:,} B"
    yield Part("scenes", "host", counts.motions * scene, about)
    dt = recipe.physics.timestep * recipe.physics.decimation
    longest = min(counts.longest - 1, round(env.max_seconds / dt))
    longest += LOOK_EVERY if place == "gpu" else 1
    steps = round(env.attempt_share * env.num_envs) * longest
    about = "last steps of the attempt worlds"
    yield Part("attempts", place, steps * sizes.attempt_bytes, about)
    envs = env.num_envs
    if engine == "cpu":
        threads = recipe.physics.num_threads or _cores()
        world, thread = sizes.cpu
        size = envs * world + threads * thread
        about = f"{envs} worlds x {world:,} B, {threads} threads x {thread:,} B"
    elif engine == "warp":
        warp = sizes.warp
        size = warp.fixed + envs * warp.per_world
        about = (
            f"{envs} worlds x {warp.per_world:,} B with room for "
            f"{warp.room.contacts} contacts, {warp.room.rows} constraint rows"
        )
    else:
        size, about = 0, "brax: not computed, JAX reserves memory by its own settings"
    yield Part("physics", place, size, about)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class MemoryPlan:
    """Parts of a run, and what the machine has."""

    recipe: Recipe
    device: Pool  # where the learner lives
    parts: list[Part]
    machine: Machine  # free memory
    sizes: Rehearsal = field(repr=False)  # what the parts are products of

    def need(self, pool: Pool, *, certain: bool = False) -> int:
        """Bytes that a pool must give; ``certain`` leaves out what is assumed."""
        parts = (p for p in self.parts if p.pool == pool)
        return sum(p.size for p in parts if not (certain and p.assumed))

    def share(self, pool: Pool, *, certain: bool = False) -> float:
        """Need over what is free; 0 where nobody knows what is free."""
        free = self.machine.free(pool)
        return 0.0 if free is None else self.need(pool, certain=certain) / max(free, 1)

    @property
    def short(self) -> list[Pool]:
        """Pools that are certainly too small."""
        return [pool for pool in POOLS if self.share(pool, certain=True) > 1]

    @property
    def fits(self) -> bool:
        """Whether nothing is certainly too small."""
        return not self.short

    @property
    def tight(self) -> list[Pool]:
        """Pools that are nearly full, or too small by what is only assumed."""
        return [p for p in POOLS if p not in self.short and self.share(p) > TIGHT]

    @property
    def largest_buffer(self) -> int:
        """Most replay rows that fit where they are planned, two digits."""
        pool, wanted = replay_pool(self.recipe, self.device), self.recipe.algo
        free, width = self.machine.free(pool), self.sizes.row_bytes
        if free is None or not width:
            return wanted.buffer_size
        rest = self.need(pool) - wanted.buffer_size * width
        return round_down(int(TIGHT * free - rest) // width)

    def change(self, **values: object) -> MemoryPlan:
        """The plan with other values of ``part.key``, written ``part__key``."""
        recipe = self.recipe
        for name, value in values.items():
            part, key = name.split("__")
            changed = dataclasses.replace(getattr(recipe, part), **{key: value})
            recipe = dataclasses.replace(recipe, **{part: changed})
        parts = list_parts(recipe, self.sizes, device=self.device)
        return dataclasses.replace(self, recipe=recipe, parts=parts)

    def on(self, machine: Machine) -> MemoryPlan:
        """The same plan on another machine."""
        return dataclasses.replace(self, machine=machine)


def round_down(number: int) -> int:
    """Two significant digits, towards zero; negative numbers are 0."""
    unit = 10 ** max(0, len(str(max(number, 0))) - 2)
    return max(0, number) // unit * unit


def plan_memory(
    recipe: Recipe,
    *,
    library: MotionLibrary | None = None,
    machine: Machine | None = None,
    device: Pool | None = None,
    run_dir: Path | None = None,
) -> MemoryPlan:
    """Compute what a run of a recipe will need, here and where the trainer will put it.

    Without a library the prepared one is looked for, and the worst case taken where
    there is none.

    Raises:
        MissingExtraError: the physics engine is not installed.

    Example:
        >>> from flashdex.recipe import compose
        >>> plan = plan_memory(compose("quickstart"))  # doctest: +SKIP
        >>> plan.need("host"), plan.fits  # doctest: +SKIP
    """
    if device is None:
        device = "gpu" if learner_device(recipe).type == "cuda" else "host"
    library = library or find_library(recipe)
    known = None if library is None else Collection.of(library)
    sizes = Rehearsal(recipe, known or Collection.assumed(recipe))
    machine = machine or look_at_machine(run_dir or Path())
    parts = list_parts(recipe, sizes, device=device)
    return MemoryPlan(recipe, device, parts, machine, sizes)


def overrides_that_fit(plan: MemoryPlan) -> list[str]:
    """Changes that make a plan fit, each a line of ``key=value`` words by itself."""
    recipe, found = plan.recipe, []
    if recipe.train.checkpoint_replay:
        found.append(_change(plan, fewer_rows=False, train__checkpoint_replay=False))
    found.append(_change(plan))
    if plan.sizes.row_bytes and replay_pool(recipe, plan.device) == "gpu":
        found.append(_change(plan, algo__replay="pinned"))
    wanted = {
        "env__num_envs": recipe.env.num_envs,
        "algo__batch_size": recipe.algo.batch_size,
    }
    for key, value in wanted.items():
        found.append(_halved(plan, {key: value}, fewer_rows=False))
    if not any(found):
        found.append(_halved(plan, wanted, fewer_rows=True))
    return [words for words in found if words]


def _halved(plan: MemoryPlan, wanted: dict[str, int], *, fewer_rows: bool) -> str:
    """The largest halves that fit, in words, else empty; at least 2 remain."""
    steps = range(1, min(wanted.values()).bit_length() - 1)
    tried = (
        _change(plan, fewer_rows=fewer_rows, **{k: v >> i for k, v in wanted.items()})
        for i in steps
    )
    return next((words for words in tried if words), "")


def _change(plan: MemoryPlan, *, fewer_rows: bool = True, **values: object) -> str:
    """A change in words where it fits, if need be with fewer rows; else empty."""
    changed = plan.change(**values)
    words = [f"{k.replace('__', '.')}={str(v).lower()}" for k, v in values.items()]
    if changed.fits and words:
        return " ".join(words)
    algo, rows = changed.recipe.algo, changed.largest_buffer
    enough = max(algo.min_buffer, algo.batch_size) <= rows < algo.buffer_size
    if fewer_rows and enough and changed.change(algo__buffer_size=rows).fits:
        return " ".join([*words, f"algo.buffer_size={rows}"])
    return ""


def format_size(size: int) -> str:
    """Bytes in decimal units, three digits."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 999.5:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:,.0f} GB" if value >= 99.5 else f"{value:.3g} GB"


def used(plan: MemoryPlan, *pools: Pool) -> str:
    """Need of each pool, and what it has."""
    return "; ".join(
        f"{NAMES[p]} {format_size(plan.need(p))} of "
        f"{format_size(plan.machine.free(p) or 0)} free"
        for p in pools
    )


def assumption(plan: MemoryPlan) -> str:
    """What is assumed of motions that are not prepared; empty where they are."""
    counts = plan.sizes.collection
    if counts.known:
        return ""
    return (
        f"the motions are not prepared yet: {counts.motions} motions of "
        f"{counts.longest / counts.fps:g} s with {counts.objects} objects are assumed"
    )


def _refusal(plan: MemoryPlan) -> str:
    lines = [
        f"{plan.recipe.name}: this machine has too little memory: "
        f"{used(plan, *plan.short)}."
    ]
    largest = sorted(plan.parts, key=lambda p: p.size, reverse=True)
    for pool in plan.short:
        tops = [p for p in largest if p.pool == pool][:3]
        named = ", ".join(f"{p.name} {format_size(p.size)}" for p in tops)
        lines.append(f"  most of the {NAMES[pool]}: {named}")
    if found := overrides_that_fit(plan):
        lines += ["Any of these fits:", *(f"  {words}" for words in found)]
    else:
        lines.append(
            "No smaller buffer, batch or number of worlds is enough: use a machine "
            "with more memory."
        )
    lines.append(f"All parts: flashdex doctor {plan.recipe.name}")
    return "\n".join(lines)


def check_memory(
    recipe: Recipe, *, library: MotionLibrary | None = None, run_dir: Path | None = None
) -> str:
    """Refuse a run that cannot fit, before anything is allocated.

    Returns:
        One line about what the run will need. Where it is tight a warning is logged.

    Raises:
        FlashdexError: some memory is certainly too small; says which overrides fit.
    """
    plan = plan_memory(recipe, library=library, run_dir=run_dir)
    if not plan.fits:
        raise FlashdexError(_refusal(plan))
    if plan.tight:
        note = f" ({assumption(plan)})" if assumption(plan) else ""
        _LOG.warning("memory is tight: %s%s", used(plan, *plan.tight), note)
    free = plan.machine.free
    known: list[Pool] = [p for p in POOLS if plan.need(p) and free(p) is not None]
    return f"memory: {', '.join(used(plan, pool) for pool in known)}"
