"""What an update costs by counting: products, parameters, bytes. No speed is measured.

    python -m benchmarks.arithmetic

Products are counted on the library's own update at a small batch and scaled: they grow
with the batch in proportion, which the second count checks. Ceilings are the counts
over the rates given, so they are arithmetic, not results.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

from benchmarks.common.ceilings import count_products, total_flops
from benchmarks.learner import SIZES, make_batch, make_loss
from flashdex.objectives.stepper import FlashSACStepper

COUNTED = (64, 128)  # rows of the counted updates
ROW_BYTES = 990  # two XHands, two objects: `python -m benchmarks.replay`


def flop_of(batch: int) -> float:
    """Operations of the products of one update of B rows at the paper's widths."""
    size = replace(SIZES["paper"], batch=batch)
    stepper, td = FlashSACStepper(make_loss(size)), make_batch(size)
    stepper.update(td)  # the first one makes the optimisers' state
    stepper.update(td)
    pair = count_products(lambda: (stepper.update(td), stepper.update(td)))
    return total_flops(pair) / 2


def bytes_of(batch: int) -> dict[str, float]:
    """Bytes that an update of B rows has to move at least, by what for."""
    size = SIZES["paper"]
    loss = make_loss(replace(size, batch=2))
    critic = sum(p.numel() for p in loss.qvalue_network.parameters())
    actor = sum(p.numel() for p in loss.actor_network.parameters())
    # Adam reads weight, gradient and two moments, and writes three of them; the target
    # is read and written once with the weight; the actor steps every second update
    optimiser = 4 * (critic * (7 + 3) + 0.5 * actor * 7)
    # per member and block: the wide and the narrow activations of both window ends are
    # written once and read once forward, and both again backward
    members, blocks = 2 * size.groups, 2
    wide = 2 * batch * members * blocks * (4 + 1) * size.critic
    return {
        "critic_parameters": critic,
        "actor_parameters": actor,
        "replay_gb": batch * ROW_BYTES / 1e9,
        "optimiser_gb": optimiser / 1e9,
        "activations_gb": 4 * 4 * wide / 1e9,
    }


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=SIZES["paper"].batch)
    parser.add_argument("--tflops", type=float, nargs=2, default=(788.0, 400.0))
    parser.add_argument("--gb-per-s", type=float, default=4300.0)
    args = parser.parse_args()
    small, large = (flop_of(batch) for batch in COUNTED)
    per_row = (large - small) / (COUNTED[1] - COUNTED[0])
    flop = small + per_row * (args.batch - COUNTED[0])
    moved = bytes_of(args.batch)
    traffic = sum(v for k, v in moved.items() if k.endswith("_gb"))
    bfloat16, tf32 = args.tflops
    found = {
        "arithmetic": "update",
        "batch": args.batch,
        "gflop_counted": [round(small / 1e9, 2), round(large / 1e9, 2)],
        "tflop_per_update": round(flop / 1e12, 3),
        **{k: round(v, 4) for k, v in moved.items()},
        "ms_products_bfloat16": round(flop / bfloat16 / 1e9, 2),
        "ms_products_tf32": round(flop / tf32 / 1e9, 2),
        "ms_traffic": round(1e3 * traffic / args.gb_per_s, 2),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
