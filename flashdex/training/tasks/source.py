"""The run that a search goes on from: what it converted, and its nearest misses.

All that is needed of it is copied when the search begins; it may be deleted then.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.metrics.tally import Tally
from flashdex.recipe import Recipe, expect_kind
from flashdex.rollouts.findings import differences
from flashdex.rollouts.ledger import CONVERSIONS, check_line, read_ledger
from flashdex.rollouts.rollout import MAX_FILE
from flashdex.system.arrays import hash_content
from flashdex.system.files import open_own, own_file, own_files, own_folder, remove_own
from flashdex.system.jsonl import check_keys, read_object, write_object
from flashdex.system.run_files import MOTIONS, SOURCE, STARTS, miss_name, run_id
from flashdex.training.run_dir import load_run_recipe

# how a scene is stepped, not what it is
EFFORT = ("engine", "num_threads", "nconmax", "njmax", "iterations", "ls_iterations")


@dataclass(frozen=True)
class Source:
    """What another run left of the motions of a search."""

    run: str = ""  # its id
    converted: Mapping[str, str] = field(default_factory=dict)  # -> hash of its rollout
    # motion that it did not convert -> its line of the nearest miss
    starts: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, run_dir: Path) -> Source:
        """What a search began from; empty for one that began from nothing.

        Raises:
            RunError: the file is damaged, or a miss is not the one that it names.
        """
        found, path = read_object(run_dir, SOURCE), run_dir / SOURCE
        if not found:
            return cls()
        check_keys(found, {"run": str, "converted": dict, "starts": dict}, path, 1)
        for motion, line in found["starts"].items():
            check_keys({"starts": line}, {"starts": dict}, path, 1)
            check_line(line, path, 1)
            start = own_file(run_dir, miss_name(motion, STARTS))
            if not _is_file_of(line, start):
                raise RunError(
                    f"{start}: is not the file that {SOURCE} names, or is missing. "
                    "Restore it from a copy, or start a new search."
                )
        return cls(**found)


def read_source(source: Path, recipe: Recipe, contents: Mapping[str, str]) -> Source:
    """What a run left of motions, of which ``contents`` has the hashes.

    Raises:
        RunError: it is a run of another library, hand, physics or criterion.
    """
    theirs = expect_kind(load_run_recipe(source), Recipe, where=str(source))
    known = read_object(source, MOTIONS).get("motions", {})
    if others := _differences(theirs, recipe, known, contents):
        raise RunError(
            f"{source}: is no run to go on from, as {'; '.join(others)}. Search with "
            "what that run has, or from nothing, without --from."
        )
    names = [name for name in contents if name in known]
    lines = read_ledger(own_file(source, CONVERSIONS))
    tally = Tally(names, recipe.train.criterion, lines)
    done = {name: tally.conversions[name] for name in tally.done}
    return Source(
        run_id(source),
        {name: str(line.get("rollout_sha256") or "") for name, line in done.items()},
        {name: line for name, line in tally.misses.items() if name not in done},
    )


def _differences(
    theirs: Recipe,
    ours: Recipe,
    known: Mapping[str, str],
    contents: Mapping[str, str],
) -> list[str]:
    """In what another run differs, in words; the action space may."""
    pairs = {
        "hand": (theirs.hand, ours.hand),
        "train.criterion": (theirs.train.criterion, ours.train.criterion),
        **{
            f"physics.{f.name}": (
                getattr(theirs.physics, f.name),
                getattr(ours.physics, f.name),
            )
            for f in dataclasses.fields(ours.physics)
            if f.name not in EFFORT
        },
    }
    found = [
        f"its {text}"
        for name, pair in pairs.items()
        for text in differences(*pair, tolerance=0.0, at=name)
    ]
    others = [n for n in contents if known.get(n, contents[n]) != contents[n]]
    if others:
        text = f"its library has another content of {len(others)} motions"
        found.append(f"{text}, {', '.join(others[:3])!a}")
    elif not contents.keys() & known.keys():
        found.append("its library has none of these motions")
    return found


def take_over(source: Path, found: Source, run_dir: Path) -> None:
    """Copy what a search needs of a run into the folder of the search.

    Raises:
        RunError: a miss is not the one that its line names.
    """
    own_folder(run_dir, STARTS)
    for motion, line in found.starts.items():
        path, copy = own_file(source, miss_name(motion)), miss_name(motion, STARTS)
        is_copied = _is_file_of(line, path)
        if is_copied:
            with open_own(run_dir, copy) as file:
                file.write(path.read_bytes())
            # a run that goes on may have replaced it in between
            is_copied = _is_file_of(line, own_file(run_dir, copy))
        if not is_copied:
            raise RunError(
                f"{path}: is missing, or not the file that its line in {CONVERSIONS} "
                f"names; 'flashdex verify {source}' tells more. While that run goes "
                "on, try again."
            )
    write_object(dataclasses.asdict(found), run_dir, SOURCE)


def forget_source(run_dir: Path) -> None:
    """Remove what a search that never began has left in its folder."""
    remove_own(run_dir, SOURCE)
    for path in own_files(run_dir, STARTS, "*.npz"):
        remove_own(run_dir, STARTS, path.name)


def _is_file_of(line: Mapping[str, Any], path: Path) -> bool:
    known = line.get("miss_sha256")
    return path.is_file() and hash_content(path, most=MAX_FILE) == known
