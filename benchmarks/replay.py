"""Rows written and sampled a second, and bytes a row.

The ring is filled to the last row with rows of a real environment. The ceiling is one
wide table of the same bytes, gathered at as many random rows.
"""

from __future__ import annotations

import argparse
import gc
import re
import sys
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.ceilings import (
    copy_gb_per_s,
    gather_seconds,
    memory_gb,
    seconds_each,
)
from benchmarks.common.library import describe_scene
from flashdex import keys
from flashdex.algorithms.flashsac import FlashSACLearner
from flashdex.algorithms.inputs import HandRows
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import FlashdexError
from flashdex.recipe import Recipe
from flashdex.replay.codec import row_bytes
from flashdex.system.machine import free_host
from flashdex.training.build import RunBuilder, learner_device

SOURCE_WORLDS = 64  # of the environment whose rows are copied into the ring
SOURCE_STEPS = 24
PUSH = 4096  # rows pushed at once: a vector step of so many worlds
SPARE = 0.9  # share of the free memory that a ring may take
HOST = torch.device("cpu")
# networks play no part: as narrow as they can be
SMALL = ("physics=cpu", f"env.num_envs={SOURCE_WORLDS}", "algo.actor_width=8")
SMALL += ("algo.critic_width=8", "algo.min_buffer=1", "algo.kind=flashsac")


def main(words: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Measure, and print one JSON object for each number of rows; they are returned."""
    args = _parse(words)
    results = []
    for rows in args.rows:
        changes = [*SMALL, f"algo.buffer_size={rows}"]
        if args.replay is not None:
            changes.append(f"algo.replay={args.replay}")
        if args.batch is not None:
            changes.append(f"algo.batch_size={args.batch}")
        recipe = output.compose_bench(args, changes=changes)
        results.append(output.emit(measure(recipe, seconds=args.seconds), out=args.out))
        gc.collect()
    return results


def measure(recipe: Recipe, *, seconds: float) -> dict[str, Any]:
    """Rows a second, bytes a row, shares of the ceilings; ``algo`` says of what.

    Each figure but the filling takes some seconds.
    """
    bench = RunBuilder.from_recipe(recipe)
    learner = bench.make_learner(env := bench.make_env())
    assert isinstance(learner, FlashSACLearner)
    device, rows = learner_device(recipe), recipe.algo.buffer_size
    kept_on = device if recipe.algo.replay in ("auto", "device") else HOST
    block, pack = _make_block(env, learner, seconds=seconds)
    width = row_bytes(block)
    _refuse(rows, width, kept_on)
    found = _fill(learner, block, rows) | _sample(learner, width, seconds=seconds)
    del learner  # the table of the ceiling takes its place
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    batch = recipe.algo.batch_size
    # threads may still hold the ring: the table takes no more than there is room for
    table = min(rows, int(SPARE * _free_memory(kept_on)) // (2 * width))
    gather = gather_seconds(
        table, width, batch, kept_on=kept_on, device=device, seconds=seconds
    )
    size = min(rows * width, 1 << 30)
    return {
        "benchmark": "replay",
        "recipe": recipe.name,
        "replay": recipe.algo.replay,
        "prefetch": recipe.algo.prefetch,
        "device": str(device),
        "rows": rows,
        "batch": batch,
        **describe_scene(bench.library),
        "packed_rows_per_s": round(len(block) / pack),
        **found,
        "ceiling_rows_per_s": round(batch / gather),
        "ceiling_table_rows": table,
        "share_of_gather": round(1e3 * gather / found["ms_sample"], 3),
        "copy_gb_per_s": copy_gb_per_s(kept_on, num_bytes=size, seconds=seconds),
    }


def _sample(learner: FlashSACLearner, width: int, *, seconds: float) -> dict[str, Any]:
    """Rows drawn a second, as they are and as what the loss reads; bytes a row."""
    batch = learner.config.batch_size
    draw = seconds_each(learner.buffer.draw, seconds=seconds)
    whole = seconds_each(learner.sample, seconds=seconds)
    rows: Any = learner.buffer.storage
    kept = sum(leaf.numel() * leaf.element_size() for leaf in rows._storage.values())
    return {
        "bytes_per_row": width,
        "stored_bytes_per_row": round(kept / rows.max_size, 2),
        "gb": round(kept / 1e9, 3),
        "sampled_rows_per_s": round(batch / draw),
        "assembled_rows_per_s": round(batch / whole),
        "ms_sample": round(1e3 * draw, 4),
        "ms_sample_assembled": round(1e3 * whole, 4),
        "sampled_gb_per_s": round(batch * width / draw / 1e9, 3),
        "memory_gb": memory_gb(learner.device),
    }


def _free_memory(device: torch.device) -> int:
    """Bytes that can still be allocated; what cannot be known does not limit."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return free_host() or sys.maxsize


def _refuse(rows: int, width: int, kept_on: torch.device) -> None:
    if rows < PUSH:
        raise FlashdexError(
            f"--rows {rows} is less than the {PUSH} that are written at "
            "once. Ask for more."
        )
    needed, free = rows * width, _free_memory(kept_on)
    if needed > SPARE * free:
        raise FlashdexError(
            f"{rows} rows of {width} bytes are {needed / 1e9:.1f} GB, "
            f"and {kept_on} has {free / 1e9:.1f} GB free, of which {SPARE:.0%} may be "
            "taken. Ask for fewer --rows, or on a GPU for --replay pinned."
        )


@torch.no_grad()
def _make_block(
    env: TrackingEnv, learner: FlashSACLearner, *, seconds: float
) -> tuple[TensorDict, float]:
    """PUSH packed rows on the learner's device, and the seconds packing takes."""
    generator = torch.Generator().manual_seed(0)
    shape = (env.num_envs, 2, env.bank.num_joints)
    device, found = learner.device, []
    td = env.reset()
    for _ in range(SOURCE_STEPS):
        action = 2 * torch.rand(shape, generator=generator) - 1
        env.put_action(td, action)
        td = env.step(td)
        after = td.get("next").to(device)
        row = learner.nstep.push(
            td.select(*keys.STATE).to(device),
            action.to(device),
            torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1),
            after.select(*keys.STATE),
            after[keys.TERMINATED],
            after[keys.DONE],
        )
        if row is not None:
            found.append(row)
        td = env.reset_worlds(td["next", keys.DONE].squeeze(-1))
    rows: Any = torch.cat(found)  # pyright: ignore[reportCallIssue,reportArgumentType]
    chosen = torch.randint(len(rows), (PUSH,), generator=generator).to(learner.device)
    assert isinstance(learner.rows, HandRows)
    rows, codec = rows[chosen], learner.rows.codec
    return codec.pack(rows), seconds_each(lambda: codec.pack(rows), seconds=seconds)


def _fill(learner: FlashSACLearner, block: TensorDict, rows: int) -> dict[str, Any]:
    """Push until the ring is full, then once more around an eighth of it.

    The first pass takes fresh pages of memory, the second does what training does for
    ever after.
    """
    found = {}
    for name, wanted in (("fresh", rows), ("written", max(PUSH, rows // 8))):
        learner.buffer.push(block)
        learner.buffer.flush()
        pushes = -(-wanted // PUSH)
        begin = timer()
        for _ in range(pushes):
            learner.buffer.push(block)
        learner.buffer.flush()
        found[f"{name}_rows_per_s"] = round(pushes * PUSH / (timer() - begin))
    return found


def count_of(text: str) -> int:
    """A number of rows: ``50M``, ``200k`` or plain digits."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is no count: 50M, 200k or 4096")
    return int(float(match[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[match[2]])


def _parse(words: Sequence[str]) -> argparse.Namespace:
    parser = output.make_parser("replay", __doc__)
    output.add_recipe_options(parser)
    parser.set_defaults(objects=2)
    add, places = parser.add_argument, ["auto", "device", "pinned", "cpu"]
    add("--rows", type=count_of, nargs="+", default=[100_000], help="100k, 1M ...")
    add("--replay", choices=places, help="where they lie")
    add("--batch", type=int, help="rows a sample; the recipe's if absent")
    add("--seconds", type=float, default=2.0, help="for each figure")
    return parser.parse_intermixed_args(words)


if __name__ == "__main__":
    output.run(main)
