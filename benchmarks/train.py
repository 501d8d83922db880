"""The whole training loop, and its parts alone.

Physics alone and updates alone are measured in the same process before and after the
loop, so that the loop's figures are shares of what was possible at that moment.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.ceilings import memory_gb, reset_peak_memory
from benchmarks.common.turns import physics_rate, room_used
from benchmarks.env import describe_bench
from flashdex.recipe import Recipe, dump_recipe
from flashdex.system.allocator import keep_freed_memory
from flashdex.system.run_files import new_run
from flashdex.training.build import RunBuilder
from flashdex.training.run_dir import make_trainer
from flashdex.training.tasks.tracking import TrackingTask
from flashdex.training.trainer import Trainer

WARM_UPDATES = 8  # an even number, so that the actor stepped too
COPIED = ("updates_per_step", "bfloat16", "compile", "replay")  # of the algorithm
# No certificates, films or checkpoints, an actor that steps from the start, and a loop
# that learns from the first batches on.
CHANGES = (
    "train.certify=false",
    "train.render_conversions=false",
    "train.checkpoint_replay=false",
    "train.stop_when_all_converted=false",
    "algo.actor_delay=0",
)


def main(words: Sequence[str] = ()) -> dict[str, Any]:
    """Measure, and print one JSON object; it is returned."""
    parser = output.make_parser("train", __doc__)
    output.add_recipe_options(parser)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the loop")
    parser.add_argument(
        "--ceiling-seconds", type=float, default=4.0, help="of each part alone"
    )
    args = parser.parse_intermixed_args(words)
    # learning from the first few batches of rows on
    first = output.compose_bench(args, changes=(*CHANGES, "algo.min_buffer=1"))
    rows = max(2 * first.algo.batch_size, 4 * first.env.num_envs)
    least = f"algo.min_buffer={min(rows, first.algo.buffer_size)}"
    recipe = output.compose_bench(args, changes=(*CHANGES, least))
    keep_freed_memory()
    if recipe.train.torch_threads:
        torch.set_num_threads(recipe.train.torch_threads)
    found = measure(recipe, seconds=args.seconds, ceiling_seconds=args.ceiling_seconds)
    return output.emit(found, out=args.out)


def measure(
    recipe: Recipe, *, seconds: float, ceiling_seconds: float
) -> dict[str, Any]:
    """Build a trainer of an off-policy learner as a run does; drive its vector step.

    Each part alone is measured before and after.
    """
    with _open_trainer(recipe) as (trainer, described, built):
        device = trainer.learner.device
        reset_peak_memory(device)
        warm = _warm_up(trainer)
        before = _ceilings(trainer, seconds=ceiling_seconds)
        td = _restart(trainer)
        loop = _loop(trainer, td, seconds=seconds)
        after = _ceilings(trainer, seconds=ceiling_seconds)
        left = {
            "rows": trainer.learner.num_rows,
            "overflow": trainer.env.physics.take_overflow(),
            **room_used(trainer.env),
            "memory_gb": memory_gb(device),
        }
    physics, learner = (0.5 * (a + b) for a, b in zip(before, after, strict=True))
    rate, updates = loop["env_steps_per_s"], loop["updates_per_s"]
    worlds = recipe.env.num_envs
    alone = worlds / physics + recipe.algo.updates_per_step / learner
    return {
        "benchmark": "train",
        **described,
        "batch": recipe.algo.batch_size,
        "critic": recipe.algo.critic_width,
        **{name: getattr(recipe.algo, name) for name in COPIED},
        **loop,
        "ceiling_physics_env_steps_per_s": round(physics, 1),
        "ceiling_updates_per_s": round(learner, 2),
        "ceilings_before_after": [
            [round(x, 2) for x in pair] for pair in (before, after)
        ],
        "share_of_physics": round(rate / physics, 4),
        "share_of_learner": round(updates / learner, 4),
        # physics and updates one after the other, and nothing else
        "share_of_both": round(rate * alone / worlds, 4),
        "build_s": round(built, 2),
        "warm_up_s": round(warm, 2),
        **left,
    }


@contextmanager
def _open_trainer(recipe: Recipe) -> Iterator[tuple[Trainer, dict[str, Any], float]]:
    """A trainer in a temporary run folder, what it is, and the seconds it took."""
    begin = timer()
    bench = RunBuilder.from_recipe(recipe)
    with (
        tempfile.TemporaryDirectory(prefix="flashdex-bench-") as folder,
        new_run(Path(folder), dump_recipe(recipe)),
    ):
        torch.manual_seed(recipe.seed)
        trainer = make_trainer(TrackingTask(bench), Path(folder), None, [])
        described = describe_bench(bench, trainer.env)
        try:
            with trainer.guard:
                yield trainer, described, timer() - begin
        finally:
            trainer.worker.close()
            trainer.close(wait=False)


def _warm_up(trainer: Trainer) -> float:
    """Seconds until some updates are done: kernels, compilation, buffers."""
    begin = timer()
    td = _restart(trainer)
    while trainer.learner.updates < WARM_UPDATES:
        td = trainer.vector_step(td)
    return timer() - begin


def _restart(trainer: Trainer) -> TensorDictBase:
    """New episodes everywhere, as after a resume."""
    trainer.learner.forget_episodes()
    return trainer.reset()


def _ceilings(trainer: Trainer, *, seconds: float) -> tuple[float, float]:
    """Env steps a second of the physics alone, updates of the learner alone."""
    physics = physics_rate(trainer.env, seconds=seconds)
    learner = trainer.learner
    updates = learner.updates
    begin = end = timer()
    while end - begin < seconds or learner.updates < updates + 2:
        for _ in range(8):
            # as the loop asks: samples come together
            for _ in range(learner.num_updates()):
                learner.update()
        end = timer()
    return physics, (learner.updates - updates) / (end - begin)


def _loop(trainer: Trainer, td: TensorDictBase, *, seconds: float) -> dict[str, Any]:
    """Drive the loop; the device is waited for at the end of a block of steps."""
    worlds = trainer.env.num_envs
    trainer.stats.pop(1.0, worlds)
    steps, updates = trainer.env_steps, trainer.learner.updates
    begin = end = timer()
    block = 1
    while end - begin < seconds:
        for _ in range(block):
            td = trainer.vector_step(td)
        end = timer()
        block = min(2 * block, 64)
    spent = end - begin
    phases = trainer.stats.pop(spent, worlds)
    names = [name for name in phases if name.startswith("perf/ms_")]
    return {
        "env_steps_per_s": round((trainer.env_steps - steps) / spent, 1),
        "updates_per_s": round((trainer.learner.updates - updates) / spent, 3),
        "seconds": round(spent, 2),
        "vector_steps": (trainer.env_steps - steps) // worlds,
        "ms_by_phase": {n.removeprefix("perf/ms_"): round(phases[n], 3) for n in names},
    }


if __name__ == "__main__":
    output.run(main)
