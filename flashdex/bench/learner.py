"""``flashdex bench learner``: the FlashSAC update against its plainest form.

Both hold the same weights and see the same batch and noise; they take turns in one
process, so that what else runs on the machine slows both alike. An actor step comes
with every second update, so every figure is the mean of two updates.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from torch import Tensor

from flashdex.allocator import keep_freed_memory
from flashdex.bench.learner_recipe import measure_recipe
from flashdex.bench.learner_sizes import (
    SIZES,
    LearnerSize,
    make_batch,
    make_loss,
    make_plain,
)
from flashdex.bench.machine import describe_commit, describe_hardware
from flashdex.bench.products import count_products, replay_seconds, total_flops
from flashdex.objectives.stepper import FlashSACStepper

BURN_IN = 2  # pairs of updates that are not counted
NORMAL_SIZES = ("quickstart", "b512", "b2048")
Update = Callable[[], object]


def measure(
    size: LearnerSize, *, rounds: int, compile: bool = False, autocast: bool = False
) -> dict[str, Any]:
    """Let the learners take turns.

    Args:
        size: shapes.
        rounds: pairs of updates of each.
        compile: also measure both learners compiled.
        autocast: also measure the library's with products in bfloat16.

    Returns:
        Milliseconds per update, their ratios to the plain learner (medians over
        rounds), split, share of the products, GFLOP/s and their ceiling.
    """
    torch.manual_seed(0)
    arms, stepper = _make_arms(size, compile=compile, autocast=autocast)
    for update in arms.values():
        _seconds_of_pair(update, BURN_IN)
    times: dict[str, list[float]] = {name: [] for name in arms}
    for _ in range(rounds):
        for name, update in arms.items():
            times[name].append(_seconds_of_pair(update))
    out: dict[str, Any] = {
        "rounds": rounds,
        "baseline_ms_per_update": _ms(times["baseline"]),
    }
    if compile:
        plain = times.pop("baseline_compiled")
        out["baseline_ms_per_update_compiled"] = _ms(plain)
        out["ratio_of_compiled"] = _ratio(times["compiled"], plain)
    for name in times.keys() - {"baseline"}:
        out[f"ms_per_update_{name}"] = _ms(times[name])
        out[f"ratio_to_baseline_{name}"] = _ratio(times[name], times["baseline"])
    out["ratio_to_baseline"] = out["ratio_to_baseline_eager"]
    whole = median(times["eager"])
    out["split"] = _split(stepper, size, whole=whole, rounds=rounds)
    return out | _products(arms["eager"], whole, repeat=rounds)


def _make_arms(
    size: LearnerSize, *, compile: bool, autocast: bool
) -> tuple[dict[str, Update], FlashSACStepper]:
    loss = make_loss(size)
    td, plain_batch = make_batch(size)
    shape = (size.groups, size.batch, size.action)
    noise = {name: torch.randn(shape) for name in ("actor_noise", "target_noise")}
    plain = make_plain(size, loss)
    stepper = FlashSACStepper(loss)
    arms: dict[str, Update] = {
        "baseline": lambda: plain.update(plain_batch, **noise),
        "eager": lambda: stepper.update(td, **noise),
    }
    if autocast:
        rounded = FlashSACStepper(make_loss(size), autocast=True)
        arms["autocast"] = lambda: rounded.update(td, **noise)
    if compile:
        fast = FlashSACStepper(make_loss(size), compile=True)
        arms["compiled"] = lambda: fast.update(td, **noise)
        plain_fast = make_plain(size, loss)
        plain_fast.compile()
        arms["baseline_compiled"] = lambda: plain_fast.update(plain_batch, **noise)
    return arms, stepper


def _seconds_of_pair(update: Update, pairs: int = 1) -> float:
    """Seconds per update over pairs of updates, each with one actor step."""
    start = time.perf_counter()
    for _ in range(2 * pairs):
        update()
    return (time.perf_counter() - start) / (2 * pairs)


def _ratio(ours: list[float], theirs: list[float]) -> float:
    """Median over rounds, so that both saw the same machine."""
    return round(median(a / b for a, b in zip(ours, theirs, strict=True)), 3)


def _ms(seconds: list[float]) -> float:
    return round(1e3 * median(seconds), 3)


def _split(
    stepper: FlashSACStepper, size: LearnerSize, *, whole: float, rounds: int
) -> dict[str, float]:
    """Milliseconds of one update: reading, actor, critic, and what steps weights."""
    loss, (td, _) = stepper.loss, make_batch(size)
    noise = torch.randn(size.groups, size.batch, size.action)
    batch = loss.read(td)

    def differentiate(value: Tensor) -> None:
        value.backward()
        for parameter in loss.parameters():
            parameter.grad = None

    calls: dict[str, Update] = {
        "read": lambda: loss.read(td),
        "actor": lambda: differentiate(loss.actor_objective(batch, noise)[0]),
        "critic": lambda: differentiate(loss.qvalue_objective(batch, noise)[0]),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - start)
    split = {name: _ms(values) for name, values in times.items()}
    split["actor"] = round(split["actor"] / stepper.actor_period, 3)
    # what is left: optimisers, projections, target average, report
    split["step"] = round(max(0.0, 1e3 * whole - sum(split.values())), 3)
    return split


def _products(update: Update, whole: float, *, repeat: int) -> dict[str, float]:
    """Speed of the matrix products; the share is what they would take by themselves."""
    counts = count_products(lambda: (update(), update()))
    seconds = replay_seconds(counts, repeat=repeat) / 2
    gflop = total_flops(counts) / 2 / 1e9
    return {
        "gflop_per_update": round(gflop, 3),
        "matmul_share": round(seconds / whole, 3),
        "gflops": round(gflop / whole, 1),
        "ceiling_gflops": round(gflop / seconds, 1),
        "ceiling_ms_per_update": round(1e3 * seconds, 3),
    }


def main(words: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, and print one JSON object a size, one a line.

    Args:
        words: ``--sizes NAME ...``, ``--rounds N``, ``--threads N``, ``--compile``.

    Returns:
        The printed objects.
    """
    args = _parse(words or [])
    keep_freed_memory()  # as training does; both learners gain
    results = []
    before = torch.get_num_threads()
    for name in args.sizes:
        size = SIZES[name]
        torch.set_num_threads(args.threads or size.threads or before)
        rounds = args.rounds or size.rounds
        result = {
            "benchmark": "learner",
            "size": name,
            "observation": size.observation,
            "action": size.action,
            "groups": size.groups,
            "batch": size.batch,
            "critic": size.critic,
            "actor": size.actor,
            **measure(
                size, rounds=rounds, compile=args.compile, autocast=args.autocast
            ),
            "torch_threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "hardware": describe_hardware(),
            "commit": describe_commit(),
        }
        if name == "quickstart":
            # the same sizes inside the recipe, with replay and observations
            result["recipe"] = measure_recipe(name, args.overrides, updates=2 * rounds)
        sys.stdout.write(json.dumps(result) + "\n")
        sys.stdout.flush()
        results.append(result)
    torch.set_num_threads(before)
    return results


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="flashdex bench learner")
    parser.add_argument(
        "--sizes",
        nargs="+",
        choices=SIZES,
        default=list(NORMAL_SIZES),
        help="what to measure (%(default)s)",
    )
    parser.add_argument("--rounds", type=int, help="pairs of updates")
    parser.add_argument("--threads", type=int, help="torch threads")
    parser.add_argument(
        "--compile", action="store_true", help="also both compiled; minutes a size"
    )
    parser.add_argument(
        "--autocast", action="store_true", help="also with products in bfloat16"
    )
    parser.add_argument("--json", action="store_true", help="always so")
    parser.add_argument(
        "--set",
        dest="overrides",
        nargs="*",
        default=[],
        metavar="key=value",
        help="changes of the quickstart recipe",
    )
    return parser.parse_args(words)
