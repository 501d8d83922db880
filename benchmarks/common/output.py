"""The command line of a benchmark: its options, its recipe, its JSON lines."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.library import bench_library
from flashdex.errors import FlashdexError
from flashdex.recipe import Recipe, compose, expect_kind
from flashdex.system.jsonl import append_line
from flashdex.system.machine import describe_commit, describe_machine


def make_parser(name: str, about: str | None) -> argparse.ArgumentParser:
    """A parser with the options that every benchmark has, and its docstring."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=about,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="always so")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="also append the line to this file"
    )
    return parser


def add_recipe_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose recipe, worlds and scene."""
    add = parser.add_argument
    add("--recipe", default="quickstart", help="name or path (%(default)s)")
    add("--num-envs", type=int, help="worlds; the recipe's if absent")
    add("--objects", type=int, help="made-up motions of 1 or 2 objects; --hulls too")
    add("--hulls", type=int, help="convex parts of each made-up object, 1 to 16")
    add("--libraries", type=Path, help="folder of the made-up libraries (the cache)")
    add("overrides", nargs="*", metavar="key=value")


def compose_bench(args: argparse.Namespace, *, changes: Sequence[str] = ()) -> Recipe:
    """The recipe that the options of `add_recipe_options` ask for.

    The changes are overrides that stand before those of the command line.
    """
    overrides = list(changes)
    if args.num_envs is not None:
        overrides.append(f"env.num_envs={args.num_envs}")
    if args.objects is not None or args.hulls is not None:
        objects, hulls = args.objects or 2, args.hulls or 1
        path = bench_library(objects, hulls, folder=args.libraries).resolve()
        overrides += [f"motions.library={path}", "motions.count=null"]
        overrides.append("motions.select=null")
    return compose_tracking(args.recipe, [*overrides, *args.overrides])


def compose_tracking(name: str, overrides: Sequence[str]) -> Recipe:
    """A recipe of the tracking task; others are refused."""
    return expect_kind(compose(name, list(overrides)), Recipe, where="benchmarks")


def emit(result: dict[str, Any], *, out: Path | None = None) -> dict[str, Any]:
    """Print a result with what it was measured on, append it to a file, return it."""
    whole = {**result, "torch_threads": torch.get_num_threads()}
    whole |= {"hardware": describe_machine(), "commit": describe_commit()}
    print(json.dumps(whole), flush=True)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        append_line(out, whole)
    return whole


def run(main: Callable[[Sequence[str]], object]) -> None:
    """Run a benchmark; an error of the user is one message and exit code 2."""
    try:
        main(sys.argv[1:])
    except FlashdexError as error:
        print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
