"""What memory a recipe needs, whether this machine has it, and what would fit instead.

All of it is computed before anything large is allocated: rows, networks and scenes are
built tiny or without memory, and multiplied.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from flashdex.errors import FlashdexError
from flashdex.motions.library import MotionLibrary
from flashdex.recipe import Recipe
from flashdex.system.machine import Machine, Pool, look_at_machine
from flashdex.training.build import learner_device
from flashdex.training.memory_library import find_library, read_sizes, worst_sizes
from flashdex.training.memory_parts import Part, PartSizes, list_parts, replay_pool

_LOG = logging.getLogger(__name__)
TIGHT = 0.9  # share of what is free
POOLS: tuple[Pool, ...] = ("gpu", "host", "disk")


@dataclass(frozen=True)
class MemoryPlan:
    """Parts of a run, and what the machine has.

    Attributes:
        recipe: what is planned.
        device: where the learner lives.
        parts: all lines.
        machine: free memory.
        sizes: what the parts are products of.
    """

    recipe: Recipe
    device: Pool
    parts: list[Part]
    machine: Machine
    sizes: PartSizes = field(repr=False)

    def need(self, pool: Pool, *, certain: bool = False) -> int:
        """Bytes that a pool must give.

        Args:
            pool: which.
            certain: leave out what is assumed of an unprepared collection.
        """
        return sum(
            p.size for p in self.parts if p.pool == pool and not (certain and p.assumed)
        )

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
        pool = replay_pool(self.recipe, self.device)
        free, width = self.machine.free(pool), self.sizes.learner.row_bytes
        if free is None or self.recipe.algo.kind == "ppo":
            return self.recipe.algo.buffer_size
        rows = self.recipe.algo.buffer_size * width
        return round_down(int(TIGHT * free - (self.need(pool) - rows)) // width)

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
    """Compute what a run of a recipe will need.

    Args:
        recipe: validated recipe.
        library: its motions; None looks for the prepared ones and takes the worst case
            where there are none.
        machine: None looks at this one.
        device: where the learner lives; None is where the trainer will put it.
        run_dir: where checkpoints go; None is the current folder.

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
    collection = worst_sizes(recipe) if library is None else read_sizes(library)
    sizes = PartSizes(recipe, collection)
    machine = machine or look_at_machine(run_dir or Path())
    parts = list_parts(recipe, sizes, device=device)
    return MemoryPlan(recipe, device, parts, machine, sizes)


def overrides_that_fit(plan: MemoryPlan) -> list[str]:
    """Changes that make a plan fit, each a line of ``key=value`` words by itself."""
    return list(_search(plan)) or list(_smaller_in_all(plan))


def _search(plan: MemoryPlan) -> Iterator[str]:
    recipe = plan.recipe
    if recipe.train.checkpoint_replay:
        unstored = plan.change(train__checkpoint_replay=False)
        if unstored.fits:
            yield "train.checkpoint_replay=false"
    if recipe.algo.kind != "ppo":
        if rows := _enough_rows(plan):
            yield f"algo.buffer_size={rows}"
        if plan.device == "gpu" and recipe.algo.replay != "pinned":
            moved = plan.change(algo__replay="pinned")
            if moved.fits:
                yield "algo.replay=pinned"
            elif rows := _enough_rows(moved):
                yield f"algo.replay=pinned algo.buffer_size={rows}"
    for part, key in (("env", "num_envs"), ("algo", "batch_size")):
        value = getattr(getattr(recipe, part), key) // 2
        while value >= 2:
            if plan.change(**{f"{part}__{key}": value}).fits:
                yield f"{part}.{key}={value}"
                break
            value //= 2


def _smaller_in_all(plan: MemoryPlan) -> Iterator[str]:
    """Fewer worlds, a smaller batch and, where there is one, a smaller buffer."""
    envs, size = plan.recipe.env.num_envs, plan.recipe.algo.batch_size
    while min(envs, size) >= 4:
        envs, size = envs // 2, size // 2
        smaller = plan.change(env__num_envs=envs, algo__batch_size=size)
        words = f"env.num_envs={envs} algo.batch_size={size}"
        if smaller.fits:
            yield words
            return
        if rows := _enough_rows(smaller):
            yield f"{words} algo.buffer_size={rows}"
            return


def _enough_rows(plan: MemoryPlan) -> int:
    """The largest buffer where that alone makes the plan fit, else 0."""
    algo, rows = plan.recipe.algo, plan.largest_buffer
    wanted = max(algo.min_buffer, algo.batch_size)
    if not wanted <= rows < algo.buffer_size:
        return 0
    return rows if plan.change(algo__buffer_size=rows).fits else 0


def check_memory(
    recipe: Recipe, *, library: MotionLibrary | None = None, run_dir: Path | None = None
) -> str:
    """Refuse a run that cannot fit, before anything is allocated.

    Args:
        recipe: validated recipe.
        library: its motions; see `plan_memory`.
        run_dir: where checkpoints go.

    Returns:
        One line about what the run will need. Where it is tight a warning is logged.

    Raises:
        FlashdexError: some memory is certainly too small; says which overrides fit.
    """
    from flashdex.training.memory_text import refusal, summary, tight_warning

    plan = plan_memory(recipe, library=library, run_dir=run_dir)
    if not plan.fits:
        raise FlashdexError(refusal(plan))
    if plan.tight:
        _LOG.warning("%s", tight_warning(plan))
    return summary(plan)
