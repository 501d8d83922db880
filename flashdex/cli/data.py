"""The verbs of `flashdex` about data: fetch, prepare, baselines."""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flashdex.cli.interrupt import loading
from flashdex.cli.terminal import number_above, path, say
from flashdex.datasets import check_options
from flashdex.datasets.source import SourceOptions
from flashdex.errors import FlashdexError, UnknownHandError
from flashdex.hands import known_hands

if TYPE_CHECKING:  # the command line starts fast: heavy parts load in their verb
    from flashdex.motions.pipeline.prepare import Order

Handler = Callable[[argparse.Namespace], int]


def add_data_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
    """Add the verbs to the command line.

    Args:
        add: makes a verb of its name, its function and its help.
    """
    verb = add("fetch", _fetch, "download recordings that need no registration")
    verb.add_argument("name", help="myodm: 95 clips of one hand and one object")
    verb.add_argument("--out", type=path, help="folder (default: in the cache)")
    verb.add_argument("--wheel", type=path, help="package file fetched by other means")

    verb = add("prepare", _prepare, "make a motion library from recordings")
    verb.add_argument(
        "--source", required=True, help="reader; `flashdex ls` says what each reads"
    )
    verb.add_argument("--input", type=path, help="folder (or file) of the recordings")
    verb.add_argument("--hand", default="xhand", help="robot hand (%(default)s)")
    verb.add_argument("--out", type=path, help="folder of the library")
    verb.add_argument("--mano", type=path, help="folder with MANO_LEFT, MANO_RIGHT")
    verb.add_argument("--models", type=path, help="folder of the object models")
    verb.add_argument("--splits", type=path, help="file that names the splits")
    rate, count = number_above(0), number_above(0, whole=True)
    verb.add_argument(
        "--hz", type=rate, default=60.0, help="control rate, 1/s (%(default)g)"
    )
    verb.add_argument(
        "--speed",
        type=rate,
        default=1.0,
        help="of playback (%(default)g); 0.5 makes motions last twice as long",
    )
    verb.add_argument(
        "--cut",
        choices=["auto", "always", "never"],
        default="auto",
        help="cut where contact begins and ends (auto: sessions and over 20 s)",
    )
    verb.add_argument("--strict", action="store_true", help="reject what is flagged")
    verb.add_argument(
        "--workers", type=count, default=1, help="processes (%(default)s)"
    )
    verb.add_argument("--ray", action="store_true", help="use a Ray cluster")
    verb.add_argument(
        "--select", nargs="+", metavar="NAME", help="only recordings so named (globs)"
    )
    verb.add_argument("--limit", type=count, help="only the first N recordings")
    verb.add_argument(
        "--seed",
        type=number_above(-1, whole=True),
        default=0,
        help="of made-up motions",
    )
    verb.add_argument(
        "--no-thumbnails", action="store_true", help="report.html without pictures"
    )
    verb.add_argument(
        "--dry-run", action="store_true", help="list the recordings and stop"
    )

    verb = add("baselines", _baselines, "score what no learning achieves")
    verb.add_argument("recipe", help="name or path: its motions and physics")
    add_overrides(verb)
    verb.add_argument("--out", type=path, help="JSON file for every score")
    add_allow(verb)


def add_overrides(verb: argparse.ArgumentParser) -> None:
    """Add the changes of a recipe, as many as there are, to a verb."""
    verb.add_argument(
        "overrides",
        nargs="*",
        default=[],  # or argparse calls them required
        metavar="key=value",
        help="changes, e.g. motions.library=libraries/mine; docs/recipes.md",
    )


def add_allow(verb: argparse.ArgumentParser) -> None:
    """Add the packages whose code a recipe may run to a verb that reads one."""
    verb.add_argument(
        "--allow",
        action="append",
        metavar="PACKAGE",
        help="let the recipe name terms of this package of yours, which runs its code",
    )


def _fetch(args: argparse.Namespace) -> int:
    with loading():
        from flashdex.datasets.fetch import NOTE, fetch

    folder = fetch(args.name, args.out, wheel=args.wheel)
    where = "" if args.out is None else f" --input {folder}"
    say(f"{NOTE}\n{folder}")
    say(f"next: flashdex prepare --source {args.name}{where} --out libraries/myodm")
    return 0


def _prepare(args: argparse.Namespace) -> int:
    _check_words(args)
    with loading():
        from flashdex.motions.pipeline.prepare import run_order
        from flashdex.reports.library.report import (
            summary_lines,
            write_library_report,
        )

        order = _order(args)
    if args.dry_run:
        return _list_recordings(order)
    library = run_order(order, args.out, workers=args.workers, ray=args.ray)
    report = write_library_report(library, thumbnails=not args.no_thumbnails)
    say("\n".join(summary_lines(library)))
    say(f"{library.path}: figures in report.csv, pictures in {report}")
    return 0


def _check_words(args: argparse.Namespace) -> None:
    """Refuse what can be refused before anything is loaded."""
    check_options(args.source, _options(args))
    if args.hand not in known_hands():
        raise UnknownHandError(args.hand, known_hands())
    for name in ("mano", "models", "splits"):
        path = getattr(args, name)
        if path is not None and not os.path.lexists(path):
            raise FlashdexError(f"--{name}: no such file or folder: {path}")
    if args.out is None and not args.dry_run:
        raise FlashdexError("give --out: the folder of the library")
    if args.out is not None and os.path.lexists(args.out) and not args.out.is_dir():
        raise FlashdexError(f"--out: {args.out} is no folder; give a new one")


def _options(args: argparse.Namespace) -> SourceOptions:
    return SourceOptions(
        path=args.input,
        mano=args.mano,
        models=args.models,
        splits=args.splits,
        seed=args.seed,
        select=None if args.select is None else tuple(args.select),
        limit=args.limit,
    )


def _order(args: argparse.Namespace) -> Order:
    from flashdex.motions.pipeline.motion import MotionSettings
    from flashdex.motions.pipeline.prepare import Order

    settings = MotionSettings(
        hand=args.hand,
        control_hz=args.hz,
        cut=args.cut,
        speed=args.speed,
        strict=args.strict,
    )
    return Order(args.source, _options(args), settings)


def _list_recordings(order: Order) -> int:
    recordings = order.recordings()
    for recording in recordings:
        size = sum(file.stat().st_size for file in recording.files)
        name = recording.name.replace("\n", "?")  # a name is one line
        say(f"{name}  {len(recording.files)} files, {size / 1e6:.1f} MB")
    say(f"{len(recordings)} recordings")
    return 0


def _baselines(args: argparse.Namespace) -> int:
    if args.out is not None:
        _check_writable(args.out)
    with loading():
        from flashdex.recipe import Recipe, compose, expect_kind
        from flashdex.training.baselines import format_baselines, score_baselines
        from flashdex.training.build import RunBuilder

        recipe = compose(args.recipe, args.overrides)
    bench = RunBuilder.from_recipe(expect_kind(recipe, Recipe, where="baselines"))
    try:
        if args.out is not None:
            args.out.unlink(missing_ok=True)  # scores of another time are no answer
        found = score_baselines(bench, args.out)
    except OSError as error:
        if args.out is None:
            raise
        raise FlashdexError(f"--out: {args.out} cannot be written ({error})") from error
    say(format_baselines(found))
    return 0


def _check_writable(path: Path) -> None:
    """Say before the work that a file cannot be written; nothing is changed."""
    is_there = os.path.lexists(path)
    fault = ""
    if not os.access(path if is_there else path.parent, os.W_OK):
        fault = "may not" if path.parent.is_dir() else f"there is no {path.parent}"
    if is_there and not stat.S_ISREG(path.lstat().st_mode):
        fault = "a folder" if path.is_dir() else "a link, a pipe or a device"
    elif not path.parent.is_dir():
        fault = f"there is no folder {path.parent}"
    if fault:
        raise FlashdexError(
            f"--out: {path} cannot be written ({fault}). Give a file in a folder that "
            "is there."
        )
