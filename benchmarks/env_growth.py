"""How the cost of a world's step grows with hulls, objects and worlds, as ratios.

    OMP_NUM_THREADS=1 python -m benchmarks.env_growth --out lines.jsonl

All sizes stand side by side in one process and take turns, so that other work on the
machine slows them alike: each figure is a median of ratios to the first size, which
hold on a busy machine, too.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.common.library import bench_library
from benchmarks.common.output import add_output_options, emit
from benchmarks.common.turns import TurnTaker
from flashdex.envs.tracking import TrackingEnv
from flashdex.recipe import Recipe, compose, expect_kind
from flashdex.training.build import RunBuilder

STEPS = 8  # control steps of a turn
# objects, hulls, worlds; the first one is what the others are compared with
SIZES = [(2, 4, 128), (2, 1, 128), (2, 8, 128), (2, 16, 128), (1, 4, 128)]
SIZES += [(1, 1, 128), (1, 16, 128), (2, 4, 64), (2, 4, 256), (2, 4, 512), (2, 4, 1024)]


def make_env(
    objects: int, hulls: int, worlds: int, args: argparse.Namespace
) -> TrackingEnv:
    """An environment of one size."""
    library = bench_library(objects, hulls, folder=args.libraries)
    changes = [f"motions.library={library}", "motions.count=null"]
    changes += [f"env.num_envs={worlds}", "physics.num_threads=1", *args.overrides]
    recipe = expect_kind(compose(args.recipe, changes), Recipe, where="env_growth")
    return RunBuilder.from_recipe(recipe).make_env()


def measure(takers: list[TurnTaker], *, rounds: int) -> dict[str, list[list[float]]]:
    """Seconds of a world's step in each round: the environment's and the physics'."""
    targets = [taker.loop()[0] for taker in takers]
    found: dict[str, list[list[float]]] = {"env": [], "physics": []}
    for _ in range(rounds):
        each: dict[str, list[float]] = {"env": [], "physics": []}
        for taker, given in zip(takers, targets, strict=True):
            worlds = taker.env.num_envs
            each["env"].append(taker.loop()[1] / (STEPS * worlds))
            each["physics"].append(taker.replay(given) / (STEPS * worlds))
        for name, values in each.items():
            found[name].append(values)
    return found


def relative(rounds: list[list[float]], index: int) -> float:
    """Median over rounds of a size's seconds over those of the first size."""
    return round(median(values[index] / values[0] for values in rounds), 3)


def main() -> None:
    """Measure and print one JSON line a size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recipe", default="quickstart")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--libraries", type=Path)
    add_output_options(parser)
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    args = parser.parse_intermixed_args()
    begin = time.perf_counter()
    takers = [TurnTaker(make_env(*size, args), steps=STEPS) for size in SIZES]
    found = measure(takers, rounds=args.rounds)
    ratios = [
        median(p[i] / e[i] for e, p in zip(found["env"], found["physics"], strict=True))
        for i in range(len(SIZES))
    ]
    for i, (objects, hulls, worlds) in enumerate(SIZES):
        line: dict[str, Any] = {
            "benchmark": "growth",
            "recipe": args.recipe,
            "engine": "cpu" if not args.overrides else " ".join(args.overrides),
            "objects": objects,
            "hulls": hulls,
            "num_envs": worlds,
            "relative_physics": relative(found["physics"], i),
            "relative_env": relative(found["env"], i),
            "ratio": round(ratios[i], 3),
            "rounds": args.rounds,
            "seconds": round(time.perf_counter() - begin, 1),
            "torch_threads": torch.get_num_threads(),
        }
        emit(line, out=args.out)


if __name__ == "__main__":
    main()
