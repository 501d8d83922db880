"""The memory plan in words and tables."""

from __future__ import annotations

import dataclasses

from flashdex.system.machine import Pool
from flashdex.training.memory import POOLS, MemoryPlan, overrides_that_fit
from flashdex.training.memory_parts import replay_pool

CARDS = (24, 48, 80, 141)  # GB, as sold
# Of what is sold a card's driver and display take some before any program starts.
_USABLE = 0.97
_NAMES: dict[Pool, str] = {"gpu": "GPU memory", "host": "host memory", "disk": "disk"}
_SMALL = 0.01  # share of a pool below which parts are shown as one line


def format_size(size: int) -> str:
    """Bytes in decimal units, three digits."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 999.5:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:,.0f} GB" if value >= 99.5 else f"{value:.3g} GB"


def format_plan(plan: MemoryPlan) -> str:
    """Table of the parts, the verdict and what fits instead."""
    lines = [f"memory of {plan.recipe.name}"]
    for pool in POOLS:
        lines += ["", *_pool_lines(plan, pool)]
    if not plan.sizes.collection.known:
        lines += ["", _assumed(plan)]
    lines += ["", verdict(plan)]
    if not plan.fits and verdict(plan).startswith("It does not"):
        lines += [f"  {words}" for words in overrides_that_fit(plan)]
    return "\n".join(lines)


def _pool_lines(plan: MemoryPlan, pool: Pool) -> list[str]:
    parts = sorted(
        (p for p in plan.parts if p.pool == pool), key=lambda p: p.size, reverse=True
    )
    if not parts:
        return [f"{_NAMES[pool]}: nothing"]
    total = plan.need(pool)
    shown = [p for p in parts if p.size >= _SMALL * total]
    rows = [(p.name, p.size, p.detail + " *" * p.assumed) for p in shown]
    rest = [p for p in parts if p.size < _SMALL * total]
    if rest:
        names = ", ".join(p.name for p in rest)
        rows.append(("other", sum(p.size for p in rest), names))
    free = plan.machine.free(pool)
    about = "free: unknown" if free is None else f"free: {format_size(free)}"
    if pool == "gpu" and free is None:
        about = "no CUDA GPU here"
    width = max(len(name) for name, _, _ in rows)
    lines = [f"{_NAMES[pool]}: {format_size(total)} needed, {about}"]
    return lines + [
        f"  {name:<{width}}  {format_size(size):>8}  {detail}"
        for name, size, detail in rows
    ]


def _assumed(plan: MemoryPlan) -> str:
    counts = plan.sizes.collection
    return (
        f"* the motions are not prepared yet: {counts.motions} motions of "
        f"{counts.longest / counts.fps:g} s with {counts.objects} objects are assumed"
    )


def verdict(plan: MemoryPlan) -> str:
    """One sentence: it fits, it is tight, or what is short."""
    if plan.device == "gpu" and plan.machine.gpu is None:
        return (
            "There is no CUDA GPU here: see the cards below. What this computer's own "
            f"memory holds: flashdex doctor {plan.recipe.name} algo.device=cpu"
        )
    if not plan.fits:
        return f"It does not fit: {_shortages(plan, plan.short)}. Any of these fits:"
    if plan.tight:
        return f"It fits, but is tight: {_shortages(plan, plan.tight)}."
    return "It fits."


def _shortages(plan: MemoryPlan, pools: list[Pool]) -> str:
    return "; ".join(f"{_used(plan, p)} free" for p in pools)


def _used(plan: MemoryPlan, pool: Pool) -> str:
    """Need and what is free of one pool."""
    free = format_size(plan.machine.free(pool) or 0)
    return f"{_NAMES[pool]} {format_size(plan.need(pool))} of {free}"


def refusal(plan: MemoryPlan) -> str:
    """Message for a run that cannot start."""
    lines = [
        f"{plan.recipe.name}: this machine has too little memory: "
        f"{_shortages(plan, plan.short)}."
    ]
    largest = sorted(plan.parts, key=lambda p: p.size, reverse=True)
    for pool in plan.short:
        tops = [p for p in largest if p.pool == pool][:3]
        named = ", ".join(f"{p.name} {format_size(p.size)}" for p in tops)
        lines.append(f"  most of the {_NAMES[pool]}: {named}")
    found = overrides_that_fit(plan)
    if found:
        lines.append("Any of these fits:")
        lines += [f"  {words}" for words in found]
    else:
        lines.append(
            "No smaller buffer, batch or number of worlds is enough: use a machine "
            "with more memory."
        )
    lines.append(f"All parts: flashdex doctor {plan.recipe.name}")
    return "\n".join(lines)


def summary(plan: MemoryPlan) -> str:
    """One line for a run that fits."""
    used = (
        _used(plan, pool)
        for pool in POOLS
        if plan.need(pool) and plan.machine.free(pool) is not None
    )
    return f"memory: {', '.join(used)}"


def tight_warning(plan: MemoryPlan) -> str:
    """One line for a run that may not fit."""
    text = f"memory is tight: {_shortages(plan, plan.tight)}"
    if not plan.sizes.collection.known:
        text += f" ({_assumed(plan).removeprefix('* ')})"
    return text


def format_cards(plan: MemoryPlan) -> str:
    """The largest replay buffer on cards of usual sizes; for a learner on a GPU.

    Args:
        plan: with the learner on the GPU.
    """
    lines = ["largest algo.buffer_size with everything else as it is, by card:"]
    for card in CARDS:
        machine = dataclasses.replace(plan.machine, gpu=int(card * 1e9 * _USABLE))
        there = plan.on(machine)
        rows, wanted = there.largest_buffer, plan.recipe.algo.buffer_size
        moved = there.change(algo__replay="pinned")
        on_host = replay_pool(plan.recipe, "gpu") == "host"
        if on_host and moved.share("gpu") <= 1:
            text = f"all but the replay rows ({_percent(there)} used)"
        elif not on_host and rows >= wanted:
            text = f"all {wanted:,} rows ({_percent(there)} used)"
        elif not on_host and rows > 0:
            text = f"{rows:,} rows; {_pinned(plan)}"
        elif not on_host and moved.share("gpu") <= 1:
            text = f"none on the card; {_pinned(plan)}"
        else:
            text = "none; the rest alone does not fit: fewer worlds or a smaller batch"
        lines.append(f"  {card:>4} GB  {text}")
    return "\n".join(lines)


def _pinned(plan: MemoryPlan) -> str:
    size = plan.recipe.algo.buffer_size * plan.sizes.learner.row_bytes
    return f"all with algo.replay=pinned, in {format_size(size)} of host memory"


def _percent(plan: MemoryPlan) -> str:
    return f"{100 * plan.share('gpu'):.0f} %"


def format_work(plan: MemoryPlan) -> str:
    """Arithmetic of an update, and the rate at which the worlds ask for updates."""
    algo, envs = plan.recipe.algo, plan.recipe.env.num_envs
    flops = plan.sizes.learner.update_flops(algo.batch_size)
    rate = 1000 * algo.updates_per_step / envs
    return (
        f"work: an update is {flops / 1e9:,.1f} GFLOP of matrix products; every 1,000 "
        f"env steps/s ask for {rate:.3g} updates/s, {rate * flops / 1e12:.3g} TFLOP/s"
    )
