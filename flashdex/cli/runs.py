"""Verbs of runs: make one, and look at what it left."""

from __future__ import annotations

import argparse
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

from flashdex.cli.data import Handler, add_allow, add_overrides
from flashdex.cli.interrupt import loading
from flashdex.cli.terminal import path, say
from flashdex.errors import FlashdexError
from flashdex.system.run_files import ROLLOUTS, require_run


def add_run_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
    """Add ``train``, ``search`` and all that look at what they left.

    Args:
        add: makes a verb of a name, the function that runs it, and a line about it.
    """
    verb = add("train", _train, "train a recipe: train RECIPE key=value ...")
    verb.add_argument("recipe", nargs="?", help="name or path")
    add_overrides(verb)
    one = verb.add_mutually_exclusive_group()
    one.add_argument("--resume", type=path, metavar="RUN", help="continue a run")
    one.add_argument(
        "-m", "--multirun", action="store_true", help="one run for each of key=a,b"
    )
    verb.add_argument(
        "--cfg", choices=["job"], help="print the composed recipe and stop"
    )
    add_allow(verb)

    verb = add(
        "search", _search, "search for the actions of each motion, without a policy"
    )
    verb.add_argument("recipe", nargs="?", help="name or path")
    add_overrides(verb)
    one = verb.add_mutually_exclusive_group()
    one.add_argument("--resume", type=path, metavar="RUN", help="continue a search")
    one.add_argument(
        "--from",
        dest="source",
        type=path,
        metavar="RUN",
        help="leave out what a run converted, begin at its nearest misses",
    )
    verb.add_argument(
        "--workers", metavar="N", help="processes, the same as search.workers=N"
    )

    verb = add("evaluate", _evaluate, "roll every motion of a run out and score it")
    _add_run(verb)
    add_overrides(verb)
    add_allow(verb)

    verb = add("replay", _replay, "replay the stored trajectories in MuJoCo C")
    _add_run(verb)
    add_allow(verb)

    verb = add("score", _score, "score stored rollouts by every criterion")
    verb.add_argument(
        "files", type=path, nargs="+", metavar="FILE", help="rollout .npz"
    )
    verb.add_argument("--json", action="store_true", help="print JSON")

    verb = add("verify", _verify, "check every hash of runs and motion libraries")
    verb.add_argument(
        "paths",
        type=path,
        nargs="+",
        metavar="RUN|LIBRARY",
        help="folder that `train` or `prepare` wrote",
    )
    add_allow(verb)

    verb = add("report", _report, "write report.html of a run again")
    _add_run(verb)


def _add_run(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "run_dir", type=path, metavar="RUN", help="folder that `train` wrote"
    )


def _train(args: argparse.Namespace) -> int:
    if args.resume is not None:
        return _resume(args)
    if args.recipe is None:
        raise FlashdexError("give a recipe (see `flashdex ls`) or --resume RUN")
    with loading():
        from flashdex.recipe import compose, compose_runs, dump_recipe

        if args.multirun:
            recipes = compose_runs(args.recipe, args.overrides)
        else:
            recipes = [compose(args.recipe, args.overrides)]
    if args.cfg:
        say("---\n".join(dump_recipe(recipe) for recipe in recipes).rstrip())
        return 0
    with loading():
        from flashdex.training.run_dir import train

    for recipe in recipes:
        if not _show_run(train(recipe, args.overrides)):
            break
    return 0


def _resume(args: argparse.Namespace) -> int:
    with loading():
        from flashdex.recipe import dump_recipe
        from flashdex.training.run_dir import load_run_recipe, resume

    words = [args.recipe, *args.overrides] if args.recipe else args.overrides
    if args.cfg:
        say(dump_recipe(load_run_recipe(args.resume, words)).rstrip())
    else:
        _show_run(resume(args.resume, words))
    return 0


def _search(args: argparse.Namespace) -> int:
    from flashdex.recipe.store import SEARCH_TASK

    words = [*args.overrides, f"task={SEARCH_TASK}"]
    if args.workers is not None:
        words.append(f"search.workers={args.workers}")
    if args.resume is not None:
        if args.recipe is not None or args.workers is not None:
            raise FlashdexError("a search goes on as it began: give --resume RUN alone")
        with loading():
            from flashdex.training.tasks.search import resume_search

        _show_run(resume_search(args.resume), verb="search")
        return 0
    if args.recipe is None:
        raise FlashdexError("give a recipe (see `flashdex ls`) or --resume RUN")
    with loading():
        from flashdex.recipe import SearchRecipe, compose, expect_kind

        composed = compose(args.recipe, words)
        recipe = expect_kind(composed, SearchRecipe, where="search")
        from flashdex.training.tasks.search import search

    _show_run(search(recipe, words, args.source), verb="search")
    return 0


def _show_run(run_dir: Path, *, verb: str = "train") -> bool:
    """Show what a run came to; False when a signal ended it, which is no time to."""
    from flashdex.reports.run.terminal import run_summary
    from flashdex.training.session import SIGNAL, ended_by

    if ended_by(run_dir) == SIGNAL:
        say(f"stopped; go on with: flashdex {verb} --resume {run_dir}")
        return False
    say(run_summary(run_dir))
    return True


def _evaluate(args: argparse.Namespace) -> int:
    with loading():
        from flashdex.reports.run.terminal import evaluation_table
        from flashdex.training.run_dir import evaluate

    found = evaluate(args.run_dir, args.overrides)
    if "motions" in found:
        say(evaluation_table(found["motions"], found["totals"]))
    else:
        say(json.dumps(found, indent=1))
    return 0


def _replay(args: argparse.Namespace) -> int:
    if not (args.run_dir / ROLLOUTS).is_dir():  # they can be replayed without the rest
        require_run(args.run_dir)
    with loading():
        from flashdex.recipe import require_motions
        from flashdex.reports.run.terminal import finding_lines, replay_line

        require_motions(args.run_dir)
        from flashdex.rollouts.verify import verify_run
        from flashdex.training.loaded import open_truth

    truth, why = open_truth(args.run_dir)
    verified = verify_run(args.run_dir, truth)
    if verified.holds and not verified.rollouts:
        raise FlashdexError(
            f"{args.run_dir}: no stored rollout in '{ROLLOUTS}/': nothing has been "
            "converted yet."
        )
    for one in verified.rollouts:
        say(replay_line(one.motion, one.stored, one.found, holds=one.holds))
    for line in finding_lines(verified.findings, why):
        say(line)
    return 0 if verified.holds else 1


def _verify(args: argparse.Namespace) -> int:
    for folder in args.paths:  # before anything large is loaded
        require_run(folder, or_library=True)
    with loading():
        from flashdex.reports.run.terminal import verification_lines
        from flashdex.training.loaded import verify

    found = [verify(path) for path in args.paths]
    for one in found:
        lines = verification_lines(one.path, one.files, one.findings, one.why)
        say("\n".join(lines))
    return 0 if all(one.holds for one in found) else 1


def _score(args: argparse.Namespace) -> int:
    for file in args.files:
        if not file.is_file() or not zipfile.is_zipfile(file):
            fault = "is no .npz file" if file.is_file() else "there is no such file"
            raise FlashdexError(
                f"{file}: {fault}. Name stored rollouts, RUN/rollouts/*.npz; of a "
                "whole run 'flashdex replay RUN' tells more."
            )
    with loading():
        from flashdex.reports.run.terminal import finding_lines, score_table
        from flashdex.rollouts.findings import faults
        from flashdex.rollouts.rollout import Rollout
        from flashdex.rollouts.verify import verify_file

    found = {str(file): Rollout.load(file).score() for file in args.files}
    findings = {str(file): verify_file(file) for file in args.files}
    if args.json:
        plain = {f: {n: v.to_dict() for n, v in s.items()} for f, s in found.items()}
        say(json.dumps(plain, indent=1))
    else:
        say("\n\n".join(score_table(f, s) for f, s in found.items()))
    every = [finding for some in findings.values() for finding in some]
    for line in finding_lines(every):
        say(line, error=args.json)
    return 1 if faults(every) else 0


def _report(args: argparse.Namespace) -> int:
    with loading():
        from flashdex.recipe import require_motions
        from flashdex.reports.run.report import write_report

    require_motions(args.run_dir)
    say(str(write_report(args.run_dir)))
    return 0
