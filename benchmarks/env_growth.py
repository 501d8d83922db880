"""How the cost of a world's step grows with hulls, objects and worlds, as ratios.

    OMP_NUM_THREADS=1 python -m benchmarks.env_growth --out lines.jsonl

All sizes stand side by side in one process and take turns, so that other work on the
machine slows them alike: each figure is a median of ratios to the first size, which
hold on a busy machine, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.library import bench_library
from benchmarks.common.turns import Turns
from flashdex.envs.tracking import TrackingEnv
from flashdex.training.build import RunBuilder

STEPS = 8  # control steps of a turn
# objects, hulls, worlds; the first one is what the others are compared with
SIZES = [(2, 4, 128), (2, 1, 128), (2, 8, 128), (2, 16, 128), (1, 4, 128)]
SIZES += [(1, 1, 128), (1, 16, 128), (2, 4, 64), (2, 4, 256), (2, 4, 512), (2, 4, 1024)]
Rounds = list[list[float]]  # of each round, seconds of a world's step by size


def make_env(
    objects: int, hulls: int, worlds: int, args: argparse.Namespace
) -> TrackingEnv:
    """An environment of one size."""
    library = bench_library(objects, hulls, folder=args.libraries)
    changes = [f"motions.library={library}", "motions.count=null"]
    changes += [f"env.num_envs={worlds}", "physics.num_threads=1", *args.overrides]
    recipe = output.compose_tracking(args.recipe, changes)
    return RunBuilder.from_recipe(recipe).make_env()


def measure(all_turns: list[Turns], *, rounds: int) -> tuple[Rounds, Rounds]:
    """Seconds of a world's step in each round: the environment's and the physics'."""
    targets = [turns.loop()[0] for turns in all_turns]
    env: Rounds = []
    physics: Rounds = []
    for _ in range(rounds):
        env.append([])
        physics.append([])
        for turns, given in zip(all_turns, targets, strict=True):
            steps = STEPS * turns.env.num_envs
            env[-1].append(turns.loop()[1] / steps)
            physics[-1].append(turns.replay(given) / steps)
    return env, physics


def relative(rounds: Rounds, index: int) -> float:
    """Median over rounds of a size's seconds over those of the first size."""
    return round(median(values[index] / values[0] for values in rounds), 3)


def main(words: Sequence[str] = ()) -> None:
    """Measure and print one JSON line a size."""
    parser = output.make_parser("env_growth", __doc__)
    parser.add_argument("--recipe", default="quickstart")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--libraries", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    args = parser.parse_intermixed_args(words)
    begin = timer()
    all_turns = [Turns(make_env(*size, args), steps=STEPS) for size in SIZES]
    env, physics = measure(all_turns, rounds=args.rounds)
    for i, (objects, hulls, worlds) in enumerate(SIZES):
        ratio = median(p[i] / e[i] for e, p in zip(env, physics, strict=True))
        line = {
            "benchmark": "growth",
            "recipe": args.recipe,
            "engine": "cpu" if not args.overrides else " ".join(args.overrides),
            "objects": objects,
            "hulls": hulls,
            "num_envs": worlds,
            "relative_physics": relative(physics, i),
            "relative_env": relative(env, i),
            "ratio": round(ratio, 3),
            "rounds": args.rounds,
            "seconds": round(timer() - begin, 1),
        }
        output.emit(line, out=args.out)


if __name__ == "__main__":
    output.run(main)
