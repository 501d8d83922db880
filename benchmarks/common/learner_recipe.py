"""The learner inside a recipe: replay row, observation, update, one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch

from flashdex import keys
from flashdex.algorithms.flashsac import FlashSACLearner
from flashdex.algorithms.inputs import HandRows
from flashdex.envs.tracking import TrackingEnv
from flashdex.recipe import Recipe, compose, expect_kind
from flashdex.training.build import RunBuilder

ROWS_PER_BATCH = 8  # replay rows collected before measuring, in batches
BURN_IN = 4


def measure_recipe(
    name: str, overrides: list[str], *, updates: int
) -> dict[str, float | int]:
    """Build a recipe, collect rows by random actions and measure its updates.

    Args:
        name: recipe with a FlashSAC learner.
        overrides: ``key=value`` changes of it.
        updates: updates to measure, an even number: the actor steps in every second.

    Returns:
        Milliseconds per update (medians): ``sample`` draws and unpacks replay rows,
        ``assemble`` makes the observations of both window ends, ``learn`` is the update
        itself, ``whole`` everything; and the widths it was measured at.
    """
    changed = ["algo.actor_delay=0", *overrides]
    recipe = expect_kind(compose(name, changed), Recipe, where="benchmarks.learner")
    bench = RunBuilder.from_recipe(recipe)
    env = bench.make_env()
    learner = bench.make_learner(env)
    assert isinstance(learner, FlashSACLearner)
    _collect(env, learner, rows=ROWS_PER_BATCH * recipe.algo.batch_size)
    times: dict[str, list[float]] = {}
    for number in range(BURN_IN + updates):
        found = _one_update(learner)
        if number >= BURN_IN:
            for phase, seconds in found.items():
                times.setdefault(phase, []).append(seconds)
    # even and odd updates differ by the actor step
    split = {
        phase: round(500 * (median(values[::2]) + median(values[1::2])), 3)
        for phase, values in times.items()
    }
    with torch.no_grad():
        shown = learner.sample()[0]
    return {**split, "observation": shown[keys.OBSERVATION].shape[-1]}


@torch.no_grad()
def _collect(env: TrackingEnv, learner: FlashSACLearner, *, rows: int) -> None:
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    while learner.num_rows < rows:
        shape = (env.num_envs, 2, env.bank.num_joints)
        action = 2 * torch.rand(shape, generator=generator) - 1
        for side, value in zip(keys.SIDES, action.unbind(1), strict=True):
            td.set(keys.action(side), value)
        td, following = env.step_and_maybe_reset(td)
        after = td.get("next")
        reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
        terminated, done = after[keys.TERMINATED], after[keys.DONE]
        learner.process_step(td, action, reward, after, terminated, done)
        td = following


def _one_update(learner: FlashSACLearner) -> dict[str, float]:
    """Seconds of each phase: the parts by themselves, then a whole update."""
    times: dict[str, float] = {}

    def clock(phase: str, call: Callable[[], object]) -> None:
        start = time.perf_counter()
        call()
        times[phase] = time.perf_counter() - start

    rows = learner.rows
    assert isinstance(rows, HandRows)
    state, _ = rows.codec.unpack(learner.buffer.draw())
    clock("sample", lambda: rows.codec.unpack(learner.buffer.draw()))
    clock("assemble", lambda: rows.assemble_rows(state))
    clock("whole", learner.update)
    times["learn"] = times["whole"] - times["sample"] - times["assemble"]
    return times
