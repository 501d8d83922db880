"""The `flashdex` command: one short function a verb, no logic.

Exit codes: 0 done; 1 the answer is no (a replay that fails, something missing);
2 a mistake in what was asked for.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from flashdex.cli.data import Handler, add_data_verbs
from flashdex.errors import FlashdexError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code.

    Args:
        argv: the words after `flashdex`; None reads the command line.
    """
    # Waiting threads that spin take the cores from the physics; read by OpenMP when
    # torch is first imported, so it has to stand before every lazy import below.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # likewise, by torchrl
    parser = make_parser()
    args, rest = parser.parse_known_args(argv)
    _take_overrides(parser, args, rest)
    if args.debug:
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    logging.basicConfig(
        level=logging.DEBUG if args.debug else logging.INFO,
        format="%(asctime)s %(name)s: %(message)s",
        datefmt="%H:%M:%S",
    )
    try:
        if getattr(args, "allow", None):
            from flashdex.envs.mdp.term import allow

            allow(*args.allow)
        return args.run(args)
    except FlashdexError as error:
        if args.debug:
            raise
        print(f"flashdex {args.verb}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `flashdex ls | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _take_overrides(
    parser: argparse.ArgumentParser, args: argparse.Namespace, rest: list[str]
) -> None:
    """Add words that argparse could not place to the overrides, or refuse them."""
    flags = [word for word in rest if word.startswith("-")]
    if rest and (flags or not hasattr(args, "overrides")):
        hint = ""
        if hasattr(args, "overrides"):
            hint = "; values of the recipe are written key=value, without dashes"
        parser.error(f"unknown: {' '.join(flags or rest)}{hint}")
    if rest:
        args.overrides += rest


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--debug", action="store_true", help="tracebacks and more detailed logs"
    )
    parser = argparse.ArgumentParser(
        prog="flashdex",
        description="From recorded human hand-object motions to robot-hand "
        "trajectories that hold up in physics.",
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def add(name: str, run: Handler, text: str) -> argparse.ArgumentParser:
        verb = verbs.add_parser(name, help=text, description=text, parents=[common])
        verb.set_defaults(run=run)
        return verb

    verb = add("doctor", _doctor, "say what this computer has and what is missing")
    verb.add_argument(
        "recipe", nargs="?", help="say what memory this recipe needs instead"
    )
    verb.add_argument("overrides", nargs="*", metavar="key=value")
    _add_allow(verb)
    add("ls", _ls, "list recipes with what they promise, and sources of recordings")
    _add_recipe_verbs(add)
    add_data_verbs(add)
    _add_run_verbs(add)
    return parser


def _add_allow(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--allow",
        action="append",
        metavar="PACKAGE",
        help="let the recipe name terms of this package of yours, which runs its code",
    )


def _add_recipe_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
    verb = add("cp", _cp, "copy a recipe to edit it")
    verb.add_argument("recipe", help="name or path")
    verb.add_argument("dest", help="new file or folder")

    verb = add("validate", _validate, "find every mistake in recipes")
    verb.add_argument("paths", nargs="+", metavar="PATH", help="recipe or folder")
    _add_allow(verb)


def _add_run_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
    verb = add("train", _train, "train a recipe: train RECIPE key=value ...")
    verb.add_argument("recipe", nargs="?", help="name or path")
    verb.add_argument("overrides", nargs="*", metavar="key=value")
    one = verb.add_mutually_exclusive_group()
    one.add_argument("--resume", type=Path, metavar="RUN", help="continue a run")
    one.add_argument(
        "-m", "--multirun", action="store_true", help="one run for each of key=a,b"
    )
    verb.add_argument(
        "--cfg", choices=["job"], help="print the composed recipe and stop"
    )
    _add_allow(verb)

    verb = add("evaluate", _evaluate, "roll every motion of a run out and score it")
    verb.add_argument("run_dir", type=Path, metavar="RUN")
    verb.add_argument("overrides", nargs="*", metavar="key=value")
    _add_allow(verb)

    verb = add("replay", _replay, "replay the stored trajectories in MuJoCo C")
    verb.add_argument("run_dir", type=Path, metavar="RUN")

    verb = add("score", _score, "score stored rollouts by every criterion")
    verb.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="rollout .npz"
    )
    verb.add_argument("--json", action="store_true", help="print JSON")

    verb = add("report", _report, "write report.html of a run again")
    verb.add_argument("run_dir", type=Path, metavar="RUN")


def _doctor(args: argparse.Namespace) -> int:
    from flashdex.cli.doctor import examine, examine_recipe, format_report

    if args.recipe is not None:
        report, fits = examine_recipe(args.recipe, args.overrides)
        print(report)
        return int(not fits)
    findings = examine()
    print(format_report(findings))
    return int(any(finding.status == "missing" for finding in findings))


def _ls(args: argparse.Namespace) -> int:
    from flashdex.datasets import format_sources
    from flashdex.recipe.store import format_listing, list_recipes

    print(format_listing(list_recipes()))
    print(format_sources())
    return 0


def _cp(args: argparse.Namespace) -> int:
    from flashdex.recipe import copy_recipe

    print(copy_recipe(args.recipe, args.dest))
    return 0


def _validate(args: argparse.Namespace) -> int:
    from flashdex.recipe.merge import validate_paths

    for path in validate_paths(args.paths):
        print(f"ok  {path}")
    return 0


def _train(args: argparse.Namespace) -> int:
    from flashdex.recipe import compose, compose_runs, dump_recipe
    from flashdex.training.run_dir import load_run_recipe, resume, train

    if args.resume is not None:
        words = [args.recipe, *args.overrides] if args.recipe else args.overrides
        if args.cfg:
            print(dump_recipe(load_run_recipe(args.resume, words)), end="")
        else:
            _show_run(resume(args.resume, words))
        return 0
    if args.recipe is None:
        raise FlashdexError("give a recipe (see `flashdex ls`) or --resume RUN")
    if args.multirun:
        recipes = compose_runs(args.recipe, args.overrides)
    else:
        recipes = [compose(args.recipe, args.overrides)]
    if args.cfg:
        print("---\n".join(dump_recipe(recipe) for recipe in recipes), end="")
        return 0
    for recipe in recipes:
        if not _show_run(train(recipe, args.overrides)):
            break
    return 0


def _show_run(run_dir: Path) -> bool:
    """Show what a run came to; False when a signal ended it, which is no time to."""
    from flashdex.reports.run.terminal import run_summary
    from flashdex.training.session import SIGNAL, ended_by

    if ended_by(run_dir) == SIGNAL:
        print(f"stopped; go on with: flashdex train --resume {run_dir}")
        return False
    print(run_summary(run_dir))
    return True


def _evaluate(args: argparse.Namespace) -> int:
    from flashdex.reports.run.terminal import evaluation_table
    from flashdex.training.run_dir import evaluate

    found = evaluate(args.run_dir, args.overrides)
    if "motions" in found:
        print(evaluation_table(found["motions"], found["totals"]))
    else:
        print(json.dumps(found, indent=1))
    return 0


def _replay(args: argparse.Namespace) -> int:
    from flashdex.recipe import require_motions
    from flashdex.reports.run.terminal import finding_lines, replay_line
    from flashdex.rollouts.verify import verify_run
    from flashdex.training.loaded import open_truth

    require_motions(args.run_dir)
    truth, why = open_truth(args.run_dir)
    verified = verify_run(args.run_dir, truth)
    for one in verified.rollouts:
        print(replay_line(one.motion, one.stored, one.found, holds=one.holds))
    for line in finding_lines(verified.findings, why):
        print(line)
    return 0 if verified.holds else 1


def _score(args: argparse.Namespace) -> int:
    from flashdex.reports.run.terminal import finding_lines, score_table
    from flashdex.rollouts.rollout import Rollout
    from flashdex.rollouts.verify import faults, verify_file

    found = {str(path): Rollout.load(path).score() for path in args.files}
    findings = {str(path): verify_file(path) for path in args.files}
    if args.json:
        plain = {f: {n: v.to_dict() for n, v in s.items()} for f, s in found.items()}
        print(json.dumps(plain, indent=1))
    else:
        print("\n\n".join(score_table(f, s) for f, s in found.items()))
    every = [finding for some in findings.values() for finding in some]
    for line in finding_lines(every):
        print(line, file=sys.stderr if args.json else sys.stdout)
    return 1 if faults(every) else 0


def _report(args: argparse.Namespace) -> int:
    from flashdex.recipe import require_motions
    from flashdex.reports.run.report import write_report

    require_motions(args.run_dir)
    print(write_report(args.run_dir))
    return 0
