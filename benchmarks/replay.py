"""``python -m benchmarks.replay``: rows written and sampled a second, and bytes a row.

The ring is filled to the last row with rows of a real environment. The ceiling is one
wide table of the same bytes, gathered at as many random rows.
"""

from __future__ import annotations

import argparse
import gc
import re
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.common.ceilings import copy_gb_per_s, gather_seconds
from benchmarks.common.clock import free_memory, memory_gb, now, seconds_each
from benchmarks.common.library import describe_scene
from benchmarks.common.output import emit
from benchmarks.env import add_recipe_options, compose_bench
from flashdex import keys
from flashdex.algorithms.flashsac import FlashSACLearner
from flashdex.algorithms.inputs import HandRows
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import FlashdexError
from flashdex.recipe import Recipe
from flashdex.replay.codec import row_bytes
from flashdex.training.build import RunBuilder, learner_device

SOURCE_WORLDS = 64  # of the environment whose rows are copied into the ring
SOURCE_STEPS = 24
PUSH = 4096  # rows pushed at once: a vector step of so many worlds
SPARE = 0.9  # share of the free memory that a ring may take
# networks play no part: as narrow as they can be
SMALL = ("physics=cpu", f"env.num_envs={SOURCE_WORLDS}", "algo.actor_width=8")
SMALL += ("algo.critic_width=8", "algo.min_buffer=1")


def main(words: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, and print one JSON object for each number of rows.

    Args:
        words: ``--rows 1M ...``, ``--replay device|pinned|cpu``, ``--batch B``,
            ``--seconds S``, the recipe's options and ``key=value`` overrides.

    Returns:
        The printed objects.
    """
    args = _parse(words or [])
    results = []
    for rows in args.rows:
        changes = [*SMALL, f"algo.buffer_size={rows}", "algo.kind=flashsac"]
        if args.replay is not None:
            changes.append(f"algo.replay={args.replay}")
        if args.batch is not None:
            changes.append(f"algo.batch_size={args.batch}")
        recipe = compose_bench(args, where="benchmarks.replay", changes=tuple(changes))
        results.append(emit(measure(recipe, seconds=args.seconds), out=args.out))
        gc.collect()
    return results


def measure(recipe: Recipe, *, seconds: float) -> dict[str, Any]:
    """Fill the ring of a recipe and sample from it.

    Args:
        recipe: physics on the cpu, small networks; ``algo`` says what is measured.
        seconds: for each figure but the filling.

    Returns:
        Rows a second, bytes a row, shares of the ceilings.

    Raises:
        FlashdexError: the rows do not fit into memory.
    """
    bench = RunBuilder.from_recipe(recipe)
    learner = bench.make_learner(env := bench.make_env())
    assert isinstance(learner, FlashSACLearner)
    device, rows = learner_device(recipe), recipe.algo.buffer_size
    kept_on = device if recipe.algo.replay in ("auto", "device") else _HOST
    block, pack = _make_block(env, learner, seconds=seconds)
    width = row_bytes(block)
    _refuse(rows, width, kept_on)
    filled = _fill(learner, block, rows)
    sampled = _sample(learner, width, seconds=seconds)
    del learner  # the table of the ceiling takes its place
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    places = {"kept_on": kept_on, "device": device}
    batch = recipe.algo.batch_size
    # threads may still hold the ring: the table takes no more than there is room for
    table = min(rows, int(SPARE * free_memory(kept_on)) // (2 * width))
    gather = gather_seconds(table, width, batch, seconds=seconds, **places)
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
        **filled,
        **sampled,
        "ceiling_rows_per_s": round(batch / gather),
        "ceiling_table_rows": table,
        "share_of_gather": round(1e3 * gather / sampled["ms_sample"], 3),
        "copy_gb_per_s": copy_gb_per_s(kept_on, num_bytes=size, seconds=seconds),
        "torch_threads": torch.get_num_threads(),
    }


def _sample(learner: FlashSACLearner, width: int, *, seconds: float) -> dict[str, Any]:
    """Rows drawn a second, as they are and as what the loss reads; bytes a row."""
    device, batch = learner.device, learner.config.batch_size
    draw = seconds_each(lambda: learner.buffer.draw(), device, seconds=seconds)
    whole = seconds_each(lambda: learner.sample(), device, seconds=seconds)
    rows: Any = learner.buffer.storage
    leaves = rows._storage.values()
    kept = sum(leaf.numel() * leaf.element_size() for leaf in leaves)
    return {
        "bytes_per_row": width,
        "stored_bytes_per_row": round(kept / rows.max_size, 2),
        "gb": round(kept / 1e9, 3),
        "sampled_rows_per_s": round(batch / draw),
        "assembled_rows_per_s": round(batch / whole),
        "ms_sample": round(1e3 * draw, 4),
        "ms_sample_assembled": round(1e3 * whole, 4),
        "sampled_gb_per_s": round(batch * width / draw / 1e9, 3),
        "memory_gb": memory_gb(device),
    }


_HOST = torch.device("cpu")


def _refuse(rows: int, width: int, kept_on: torch.device) -> None:
    if rows < PUSH:
        raise FlashdexError(
            f"--rows {rows} is less than the {PUSH} that are written at "
            "once. Ask for more."
        )
    needed, free = rows * width, free_memory(kept_on)
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
    found: list[TensorDict] = []
    td = env.reset()
    for _ in range(SOURCE_STEPS):
        action = 2 * torch.rand(shape, generator=generator) - 1
        env.put_action(td, action)
        td = env.step(td)
        row = _push(learner, td, action)
        if row is not None:
            found.append(row)
        td = env.restart(td["next", keys.DONE].squeeze(-1))
    rows: Any = torch.cat(found)  # pyright: ignore[reportCallIssue,reportArgumentType]
    chosen = torch.randint(len(rows), (PUSH,), generator=generator).to(learner.device)
    rows = rows[chosen]
    assert isinstance(learner.rows, HandRows)
    codec = learner.rows.codec
    pack = seconds_each(lambda: codec.pack(rows), learner.device, seconds=seconds)
    return codec.pack(rows), pack


def _push(
    learner: FlashSACLearner, td: TensorDict, action: torch.Tensor
) -> TensorDict | None:
    device = learner.device
    after = td.get("next").to(device)
    reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
    return learner.nstep.push(
        td.select(*keys.STATE).to(device),
        action.to(device),
        reward,
        after.select(*keys.STATE),
        after[keys.TERMINATED],
        after[keys.DONE],
    )


def _fill(
    learner: FlashSACLearner, block: TensorDict, rows: int
) -> dict[str, float | int]:
    """Push until the ring is full, then once more around an eighth of it.

    The first pass takes fresh pages of memory, the second does what training does for
    ever after.
    """
    device, found = learner.device, {}
    for name, wanted in (("fresh", rows), ("written", max(PUSH, rows // 8))):
        learner.buffer.push(block)
        learner.buffer.flush()
        pushes = -(-wanted // PUSH)
        begin = now(device)
        for _ in range(pushes):
            learner.buffer.push(block)
        learner.buffer.flush()
        spent = now(device) - begin
        found[f"{name}_rows_per_s"] = round(pushes * PUSH / spent)
    return found


def count_of(text: str) -> int:
    """A number of rows: ``50M``, ``200k`` or plain digits.

    Args:
        text: of the command line.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is no count: 50M, 200k or 4096")
    return int(float(match[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[match[2]])


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.replay")
    add_recipe_options(parser, recipe="quickstart")
    parser.set_defaults(objects=2)
    parser.add_argument(
        "--rows", type=count_of, nargs="+", default=[100_000], help="100k, 1M ..."
    )
    parser.add_argument(
        "--replay", choices=["auto", "device", "pinned", "cpu"], help="where they lie"
    )
    parser.add_argument(
        "--batch", type=int, help="rows a sample; the recipe's if absent"
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="for each figure")
    return parser.parse_intermixed_args(words)
