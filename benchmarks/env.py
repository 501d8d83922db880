"""``python -m benchmarks.env``: the tracking environment against its physics alone."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import duel, turns
from benchmarks.common.clock import memory_gb
from benchmarks.common.library import bench_library, describe_scene
from benchmarks.common.output import add_output_options, emit
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.tracking import TrackingEnv
from flashdex.recipe import Recipe, compose, expect_kind
from flashdex.training.build import RunBuilder


def main(words: list[str] | None = None) -> dict[str, Any]:
    """Measure, and print one JSON object.

    Args:
        words: ``--recipe NAME``, ``--num-envs N``, ``--seconds S``, ``--objects 1|2``,
            ``--hulls N``, ``--out FILE``, and ``key=value`` overrides of the recipe
            (``physics=warp`` chooses the engine).

    Returns:
        The printed object.
    """
    args = _parse(words or [])
    recipe = compose_bench(args, where="benchmarks.env")
    bench = RunBuilder.from_recipe(recipe)
    begin = time.perf_counter()
    env = bench.make_env()
    made = time.perf_counter() - begin
    found = _measure(env, recipe, seconds=args.seconds)
    result = {
        "benchmark": "env",
        **describe_bench(bench, env),
        **found,
        "build_s": round(made, 2),
        "overflow": env.physics.take_overflow(),
        **turns.room_used(env),
        "memory_gb": memory_gb(env.device),
        "torch_threads": torch.get_num_threads(),
    }
    return emit(result, out=args.out)


def _measure(env: TrackingEnv, recipe: Recipe, *, seconds: float) -> dict[str, Any]:
    if isinstance(env.physics, CpuPhysics):
        threads = recipe.physics.num_threads
        return duel.measure(env, num_threads=threads, seconds=seconds)
    return turns.measure(env, seconds=seconds)


def describe_bench(bench: RunBuilder, env: TrackingEnv) -> dict[str, Any]:
    """What was measured: recipe, engine, device, worlds and scene.

    Args:
        bench: of the recipe.
        env: its environment.
    """
    return {
        "recipe": bench.recipe.name,
        "engine": bench.recipe.physics.engine,
        "device": str(env.device),
        "num_envs": env.num_envs,
        "decimation": bench.recipe.physics.decimation,
        **describe_scene(bench.library),
    }


def add_recipe_options(parser: argparse.ArgumentParser, *, recipe: str) -> None:
    """Add the options that choose recipe, worlds and scene.

    Args:
        parser: of the benchmark.
        recipe: name of the recipe when none is given.
    """
    parser.add_argument("--recipe", default=recipe, help="name or path (%(default)s)")
    parser.add_argument("--num-envs", type=int, help="worlds; the recipe's if absent")
    parser.add_argument(
        "--objects", type=int, help="made-up motions of 1 or 2 objects; --hulls too"
    )
    parser.add_argument(
        "--hulls", type=int, help="convex parts of each made-up object, 1 to 16"
    )
    parser.add_argument(
        "--libraries", type=Path, help="folder of the made-up libraries (the cache)"
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    add_output_options(parser)


def compose_bench(
    args: argparse.Namespace, *, where: str, changes: tuple[str, ...] = ()
) -> Recipe:
    """The recipe that the options ask for.

    Args:
        args: of a parser with the recipe options.
        where: command, for messages.
        changes: overrides that stand before those of the command line.
    """
    overrides = list(changes)
    if args.num_envs is not None:
        overrides.append(f"env.num_envs={args.num_envs}")
    if args.objects is not None or args.hulls is not None:
        objects, hulls = args.objects or 2, args.hulls or 1
        path = bench_library(objects, hulls, folder=args.libraries)
        overrides += [
            f"motions.library={path.resolve()}",
            "motions.count=null",
            "motions.select=null",
        ]
    composed = compose(args.recipe, overrides + list(args.overrides))
    return expect_kind(composed, Recipe, where=where)


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.env")
    add_recipe_options(parser, recipe="quickstart")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long")
    return parser.parse_intermixed_args(words)
