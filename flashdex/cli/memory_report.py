"""The memory of a recipe as `flashdex doctor RECIPE` reports it."""

from __future__ import annotations

import dataclasses

from flashdex.system.machine import Machine, Pool
from flashdex.training.memory.plan import (
    NAMES,
    POOLS,
    MemoryPlan,
    assumption,
    format_size,
    overrides_that_fit,
    replay_pool,
    used,
)

CARDS = (24, 48, 80, 141)  # GB, as sold
# Of what is sold a card's driver and display take some before any program starts.
_USABLE = 0.97
_SMALL = 0.01  # share of a pool below which parts are shown as one line


def format_plan(plan: MemoryPlan) -> str:
    """Table of the parts, the verdict and what fits instead."""
    lines = [f"memory of {plan.recipe.name}"]
    for pool in POOLS:
        lines += ["", *_pool_lines(plan, pool)]
    if assumption(plan):
        lines += ["", f"* {assumption(plan)}"]
    return "\n".join([*lines, "", *_verdict(plan)])


def _pool_lines(plan: MemoryPlan, pool: Pool) -> list[str]:
    parts = sorted((p for p in plan.parts if p.pool == pool), key=lambda p: -p.size)
    total, free = plan.need(pool), plan.machine.free(pool)
    if not parts:
        return [f"{NAMES[pool]}: nothing"]
    large = [p for p in parts if p.size >= _SMALL * total]
    rows = [(p.name, p.size, p.detail + " *" * p.assumed) for p in large]
    if rest := parts[len(large) :]:
        names = ", ".join(p.name for p in rest)
        rows.append(("other", sum(p.size for p in rest), names))
    about = "free: unknown" if free is None else f"free: {format_size(free)}"
    if pool == "gpu" and free is None:
        about = "no CUDA GPU here"
    width = max(len(name) for name, _, _ in rows)
    return [f"{NAMES[pool]}: {format_size(total)} needed, {about}"] + [
        f"  {name:<{width}}  {format_size(size):>8}  {detail}"
        for name, size, detail in rows
    ]


def _verdict(plan: MemoryPlan) -> list[str]:
    """It fits, it is tight, or what is short and what fits instead."""
    if plan.device == "gpu" and plan.machine.gpu is None:
        return [
            "There is no CUDA GPU here: see the cards below. What this computer's own "
            f"memory holds: flashdex doctor {plan.recipe.name} algo.device=cpu"
        ]
    if not plan.fits:
        first = f"It does not fit: {used(plan, *plan.short)}. Any of these fits:"
        return [first, *(f"  {words}" for words in overrides_that_fit(plan))]
    if plan.tight:
        return [f"It fits, but is tight: {used(plan, *plan.tight)}."]
    return ["It fits."]


def format_cards(plan: MemoryPlan) -> str:
    """The largest replay buffer on cards of usual sizes; for a learner on a GPU."""
    lines = ["largest algo.buffer_size with everything else as it is, by card:"]
    for card in CARDS:
        machine = dataclasses.replace(plan.machine, gpu=int(card * 1e9 * _USABLE))
        lines.append(f"  {card:>4} GB  {_on_card(plan, machine)}")
    return "\n".join(lines)


def _on_card(plan: MemoryPlan, machine: Machine) -> str:
    there, wanted = plan.on(machine), plan.recipe.algo.buffer_size
    rows, full = there.largest_buffer, f"({100 * there.share('gpu'):.0f} % used)"
    pinned_fits = there.change(algo__replay="pinned").share("gpu") <= 1
    size = format_size(wanted * plan.sizes.row_bytes)
    pinned = f"all with algo.replay=pinned, in {size} of host memory"
    if replay_pool(plan.recipe, "gpu") == "host":
        if pinned_fits:
            return f"all but the replay rows {full}"
    elif rows >= wanted:
        return f"all {wanted:,} rows {full}"
    elif rows > 0:
        return f"{rows:,} rows; {pinned}"
    elif pinned_fits:
        return f"none on the card; {pinned}"
    return "none; the rest alone does not fit: fewer worlds or a smaller batch"


def format_work(plan: MemoryPlan) -> str:
    """Arithmetic of an update, and the rate at which the worlds ask for updates."""
    algo = plan.recipe.algo
    _, flops = plan.sizes.learner.update(algo.batch_size)
    rate = 1000 * algo.updates_per_step / plan.recipe.env.num_envs
    return (
        f"work: an update is {flops / 1e9:,.1f} GFLOP of matrix products; every 1,000 "
        f"env steps/s ask for {rate:.3g} updates/s, {rate * flops / 1e12:.3g} TFLOP/s"
    )
