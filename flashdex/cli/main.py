"""The `flashdex` command: one short function a verb, no logic.

Exit codes: 0 done; 1 the answer is no (a replay that fails, something missing);
2 a mistake in what was asked for.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import flashdex
from flashdex.cli.data import Handler, add_allow, add_data_verbs, add_overrides
from flashdex.cli.interrupt import INTERRUPTED, loading
from flashdex.cli.terminal import (
    check_words,
    path,
    path_text,
    say,
    set_up_logging,
    set_up_streams,
)
from flashdex.errors import (
    FlashdexError,
    MissingExtraError,
    is_of_machine,
    nearest,
)
from flashdex.system.run_files import ROLLOUTS, require_run


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code.

    Args:
        argv: the words after `flashdex`; None reads the command line.
    """
    # Waiting threads that spin take the cores from the physics; read by OpenMP when
    # torch is first imported, so it has to stand before every lazy import below.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # likewise, by torchrl
    # Processes that this one starts import nothing from the folder we are in.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    with loading():
        set_up_streams()
        args = _read_arguments(sys.argv[1:] if argv is None else list(argv))
        set_up_logging(debug=args.debug)
    try:
        if getattr(args, "allow", None):
            from flashdex.envs.mdp.term import allow

            allow(*args.allow)
        check_words(args)
        return args.run(args)
    except FlashdexError as error:
        if args.debug:
            raise
        say(f"flashdex {args.verb}: {error}", error=True)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # `flashdex ls | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if args.debug or not (isinstance(error, OSError) or is_of_machine(error)):
            raise
        told = (str(error) or "no memory is left").splitlines()[0]
        say(f"flashdex {args.verb}: disk or memory failed: {told}", error=True)
        return 2


def _read_arguments(words: list[str]) -> argparse.Namespace:
    """Read the words after `flashdex`; what is wrong with them ends with 2."""
    parser = make_parser()
    (verbs,) = (dict(a.choices or {}) for a in parser._actions if a.dest == "verb")
    first = next((word for word in words if not word.startswith("-")), None)
    known = f"Verbs: {', '.join(verbs)}"
    if first is not None and first not in verbs:
        parser.error(f"unknown verb '{first}'.{nearest(first, verbs)} {known}")
    args, rest = parser.parse_known_args(words)
    args.debug = "debug" in args
    if args.verb is None:
        parser.error(f"{f'unknown: {rest[0]}' if rest else 'give a verb'}. {known}")
    _take_overrides(verbs[args.verb], args, rest)
    return args


def _take_overrides(
    parser: argparse.ArgumentParser, args: argparse.Namespace, rest: list[str]
) -> None:
    """Add words that argparse could not place to the overrides, or refuse them."""
    flags = [word for word in rest if word.startswith("-")]
    if rest and (flags or not hasattr(args, "overrides")):
        hint = "."
        if flags:
            hint += nearest(flags[0], parser._option_string_actions)
        if hasattr(args, "overrides"):
            hint += " Values of the recipe are written key=value, without dashes."
        parser.error(f"unknown: {' '.join(flags or rest)}{hint}")
    if rest:
        args.overrides = [*args.overrides, *rest]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--debug",
        action="store_true",
        default=argparse.SUPPRESS,  # or a verb would forget what stands before it
        help="tracebacks and more detailed logs",
    )
    parser = argparse.ArgumentParser(
        prog="flashdex",
        parents=[common],
        allow_abbrev=False,
        description="From recorded human hand-object motions to robot-hand "
        "trajectories that hold up in physics.",
    )
    parser.add_argument(
        "--version", action="version", version=f"flashdex {flashdex.__version__}"
    )
    verbs = parser.add_subparsers(dest="verb", metavar="VERB")

    def add(name: str, run: Handler, text: str) -> argparse.ArgumentParser:
        verb = verbs.add_parser(
            name, help=text, description=text, parents=[common], allow_abbrev=False
        )
        verb.set_defaults(run=run)
        return verb

    verb = add("doctor", _doctor, "say what this computer has and what is missing")
    verb.add_argument(
        "recipe", nargs="?", help="say what memory this recipe needs instead"
    )
    add_overrides(verb)
    add_allow(verb)
    verb = add("ls", _ls, "list recipes and what they promise, options, sources, hands")
    verb.add_argument("--json", action="store_true", help="print JSON")
    _add_recipe_verbs(add)
    add_data_verbs(add)
    _add_run_verbs(add)
    return parser


def _add_recipe_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
    verb = add("cp", _cp, "copy a recipe, or an option of one, to edit it")
    verb.add_argument("recipe", help="name or path, or GROUP/OPTION: ablation/ppo")
    verb.add_argument("dest", type=path_text, help="new file, or a folder")

    verb = add("validate", _validate, "find every mistake in recipes and options")
    verb.add_argument(
        "paths",
        type=path,
        nargs="+",
        metavar="PATH",
        help="recipe, option of a group, or folder",
    )
    add_allow(verb)


def _add_run_verbs(
    add: Callable[[str, Handler, str], argparse.ArgumentParser],
) -> None:
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
    verb.add_argument("overrides", nargs="*", metavar="key=value")
    verb.add_argument("--resume", type=path, metavar="RUN", help="continue a search")
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


def _doctor(args: argparse.Namespace) -> int:
    if args.recipe is not None:
        return _doctor_recipe(args)
    is_whole = True
    with loading():
        from flashdex.cli.doctor import examine

        for finding in examine():  # some take seconds
            say(str(finding))
            is_whole &= finding.status != "missing"
    return int(not is_whole)


def _doctor_recipe(args: argparse.Namespace) -> int:
    with loading():
        from flashdex.cli.doctor import examine_recipe

        try:
            report, fits = examine_recipe(args.recipe, args.overrides)
        except MissingExtraError as error:  # that is an answer, too
            report, fits = str(error), False
    say(report)
    return int(not fits)


def _ls(args: argparse.Namespace) -> int:
    from flashdex.cli.listing import listing, listing_json

    say(listing_json() if args.json else listing())
    return 0


def _cp(args: argparse.Namespace) -> int:
    from flashdex.recipe import copy_recipe

    say(str(copy_recipe(args.recipe, args.dest)))
    return 0


def _validate(args: argparse.Namespace) -> int:
    from flashdex.recipe.store import recipe_files

    for given in args.paths:  # before anything large is loaded
        recipe_files(given)
    with loading():
        from flashdex.recipe.merge import validate_paths

        found = validate_paths(args.paths)
    for file in found:
        say(f"ok  {file}")
    return 0


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
            from flashdex.training.search import resume_search

        _show_run(resume_search(args.resume), verb="search")
        return 0
    if args.recipe is None:
        raise FlashdexError("give a recipe (see `flashdex ls`) or --resume RUN")
    with loading():
        from flashdex.recipe import SearchRecipe, compose, expect_kind

        composed = compose(args.recipe, words)
        recipe = expect_kind(composed, SearchRecipe, where="search")
        from flashdex.training.search import search

    _show_run(search(recipe, words), verb="search")
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
