"""The tracking environment against its physics alone: act at random, step, reset.

`key=value` changes the recipe; `physics=warp` chooses the engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.ceilings import memory_gb
from benchmarks.common.library import describe_scene
from benchmarks.common.turns import BareTurns, Turns, measure, room_used
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.tracking import TrackingEnv
from flashdex.training.build import RunBuilder


def main(words: Sequence[str] = ()) -> dict[str, Any]:
    """Measure, and print one JSON object; it is returned."""
    parser = output.make_parser("env", __doc__)
    output.add_recipe_options(parser)
    parser.add_argument("--seconds", type=float, default=10.0, help="how long")
    args = parser.parse_intermixed_args(words)
    bench = RunBuilder.from_recipe(output.compose_bench(args))
    begin = timer()
    env = bench.make_env()
    made = timer() - begin
    if isinstance(env.physics, CpuPhysics):
        turns = BareTurns(env, num_threads=bench.recipe.physics.num_threads)
    else:
        turns = Turns(env)
    result = {
        "benchmark": "env",
        **describe_bench(bench, env),
        **measure(turns, seconds=args.seconds),
        "build_s": round(made, 2),
        "overflow": env.physics.take_overflow(),
        **room_used(env),
        "memory_gb": memory_gb(env.device),
    }
    return output.emit(result, out=args.out)


def describe_bench(bench: RunBuilder, env: TrackingEnv) -> dict[str, Any]:
    """What was measured: recipe, engine, device, worlds and scene."""
    return {
        "recipe": bench.recipe.name,
        "engine": bench.recipe.physics.engine,
        "device": str(env.device),
        "num_envs": env.num_envs,
        "decimation": bench.recipe.physics.decimation,
        **describe_scene(bench.library),
    }


if __name__ == "__main__":
    output.run(main)
