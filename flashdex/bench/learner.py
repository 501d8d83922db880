"""``flashdex bench learner``: the FlashSAC update against its plainest form.

Both hold the same weights and see the same batch and noise; they take turns in one
process, so that what else runs on the machine slows both alike. An actor step comes
with every second update, so every figure is the mean of two updates. The rate of plain
matrix products is measured in the same run; an update's share of it is what its own
products would take at that rate, over what it took.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch

from flashdex.bench.ceilings import float32_products
from flashdex.bench.clock import memory_gb, reset_peak_memory
from flashdex.bench.learner_measure import measure
from flashdex.bench.learner_recipe import measure_recipe
from flashdex.bench.learner_sizes import SIZES
from flashdex.bench.output import add_output_options, emit
from flashdex.errors import FlashdexError
from flashdex.system.allocator import keep_freed_memory

NORMAL_SIZES = ("quickstart", "b512", "b2048")


def main(words: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, and print one JSON object a size, one a line.

    Args:
        words: ``--sizes NAME ...``, ``--rounds N``, ``--threads N``, ``--compile``,
            ``--autocast``, ``--device D``, ``--precision P``, ``--out FILE``.

    Returns:
        The printed objects.
    """
    args = _parse(words or [])
    keep_freed_memory()  # as training does; both learners gain
    device = _device(args.device)
    sizes = args.sizes or (["paper"] if device.type == "cuda" else NORMAL_SIZES)
    before = torch.get_num_threads()
    results = []
    for name in sizes:
        torch.set_num_threads(args.threads or SIZES[name].threads or before)
        with float32_products(args.precision):
            results.append(emit(_one_size(name, args, device), out=args.out))
    torch.set_num_threads(before)
    return results


def _device(name: str) -> torch.device:
    is_there = torch.cuda.is_available()
    if name == "cuda" and not is_there:
        raise FlashdexError(
            "bench learner: --device cuda, but torch sees no GPU ('flashdex doctor' "
            "says why). Use --device cpu or auto."
        )
    return torch.device("cuda" if is_there and name != "cpu" else "cpu")


def _one_size(
    name: str, args: argparse.Namespace, device: torch.device
) -> dict[str, Any]:
    size = SIZES[name]
    rounds = args.rounds or size.rounds
    reset_peak_memory(device)
    result = {
        "benchmark": "learner",
        "size": name,
        "device": str(device),
        "precision": args.precision,
        "observation": size.observation,
        "action": size.action,
        "groups": size.groups,
        "batch": size.batch,
        "critic": size.critic,
        "actor": size.actor,
        **measure(
            size,
            rounds=rounds,
            compile=args.compile,
            autocast=args.autocast,
            device=device,
        ),
        "memory_gb": memory_gb(device),
        "torch_threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    if name == "quickstart" and device.type == "cpu":
        # the same sizes inside the recipe, with replay and observations
        result["recipe"] = measure_recipe(name, args.overrides, updates=2 * rounds)
    return result


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="flashdex bench learner")
    parser.add_argument(
        "--sizes",
        nargs="+",
        choices=SIZES,
        help=f"what to measure ({', '.join(NORMAL_SIZES)}; paper on a GPU)",
    )
    parser.add_argument("--rounds", type=int, help="pairs of updates")
    parser.add_argument("--threads", type=int, help="torch threads")
    parser.add_argument(
        "--compile", action="store_true", help="also both compiled; minutes a size"
    )
    parser.add_argument(
        "--autocast", action="store_true", help="also with products in bfloat16"
    )
    parser.add_argument(
        "--device", choices=["auto", "cpu", "cuda"], default="auto", help="where"
    )
    parser.add_argument(
        "--precision",
        choices=["highest", "high"],
        default="highest",
        help="of float32 products; high is TF32 on a GPU",
    )
    add_output_options(parser)
    parser.add_argument(
        "--set",
        dest="overrides",
        nargs="*",
        default=[],
        metavar="key=value",
        help="changes of the quickstart recipe",
    )
    return parser.parse_args(words)
