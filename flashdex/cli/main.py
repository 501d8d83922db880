"""The `flashdex` command: one short function a verb, no logic.

Exit codes: 0 done; 1 the answer is no (a replay that fails, something missing);
2 a mistake in what was asked for.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence

import flashdex
from flashdex.cli.data import Handler, add_allow, add_data_verbs, add_overrides
from flashdex.cli.interrupt import INTERRUPTED, loading
from flashdex.cli.runs import add_run_verbs
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
    add_run_verbs(add)
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
