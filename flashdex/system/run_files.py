"""The files of a run: what they are called, and one reader for each that is text.

A run owns the regular files named here below its folder. It reads, writes, shows and
deletes no others: not what a link of such a name leads to, nor what lies beside them.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import re
import stat
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.system.files import (
    LOCK,
    RunHold,
    open_own,
    own_file,
    read_own,
    run_lock,
)
from flashdex.system.jsonl import (
    Schema,
    check_keys,
    read_lines,
    read_object,
    write_object,
)
from flashdex.system.names import check_name, file_stem

_LOG = logging.getLogger(__name__)

MANIFEST = "manifest.json"  # of a motion library
RECIPE, VERSIONS, DIFF = "recipe.yaml", "versions.json", "git.diff"
BASELINES, MOTIONS = "baselines.json", "motions.json"
METRICS, CSV, SESSIONS = "metrics.jsonl", "metrics.csv", "sessions.jsonl"
CONVERSIONS, EVALUATION = "conversions.jsonl", "evaluation.json"
DUMP, REPORT = "nan_dump.pt", "report.html"
SOURCE = "source.json"  # of a search that goes on from another run
FILES = (
    *(RECIPE, VERSIONS, DIFF, BASELINES, MOTIONS, METRICS, CSV, SESSIONS, CONVERSIONS),
    *(EVALUATION, DUMP, REPORT, SOURCE, LOCK),
)
CHECKPOINTS, REPLAY = "checkpoints", "checkpoints/replay"
ROLLOUTS, FILMS, WANDB = "rollouts", "films", "wandb"
MISSES, STARTS = "misses", "starts"
FOLDERS = {  # -> names of its files; what else lies there is nobody's business
    CHECKPOINTS: re.compile(r"\d{12}\.(pt|unreadable)"),
    REPLAY: re.compile(r"\d{12}(\.json|-\d{1,6}\.pt)"),
    ROLLOUTS: re.compile(r".+(\.npz|\.certificate\.json)"),
    MISSES: re.compile(r".+\.npz"),
    STARTS: re.compile(r".+\.npz"),
    FILMS: re.compile(r".+(\.mp4|\.png)"),
    WANDB: re.compile(r"(?!)"),  # all of it is W&B's
}
# a folder with one of them holds a run, or what is left of one
TRACES = (RECIPE, SESSIONS, CONVERSIONS, METRICS, BASELINES, CHECKPOINTS)
_HALF = re.compile(r"\.(.+)\.\d+\.tmp")  # what a killed process left half written
_ID = re.compile(r"[0-9a-f]{32}")
_COUNTERS: Schema = {"env_steps": int, "wall_s": float}
STARTED: Schema = {
    **_COUNTERS,
    **{"env_steps_lost": int, "overrides": list, "date": str, "run": str},
    "before": str,  # recipe of the session before, where the overrides changed it
}
ENDED: Schema = {**_COUNTERS, "why": str, "date": str, "lines": dict}


def rollout_name(motion: str) -> str:
    """Where a run keeps the rollout of a motion: the only place a line may name."""
    return f"{ROLLOUTS}/{file_stem(check_name(motion, what='motion'))}.npz"


def miss_name(motion: str, folder: str = MISSES) -> str:
    """Where a run keeps the nearest miss of a motion, its own or one to start from."""
    return f"{folder}/{Path(rollout_name(motion)).name}"


def check_run(run_dir: Path) -> None:
    """Refuse a folder in which something else stands where a run has its files.

    Raises:
        RunError: a link, a pipe, a folder or a file where the other one should be.
    """
    for name in FILES:
        own_file(run_dir, name)
    for folder, pattern in FOLDERS.items():
        for name in _names(run_dir, folder):
            if pattern.fullmatch(name):
                own_file(run_dir, folder, name)


def remove_temporaries(run_dir: Path) -> None:
    """Delete the half-written files that a killed run left behind."""
    known = re.compile("|".join(re.escape(name) for name in FILES))
    for folder, pattern in {"": known, **FOLDERS}.items():
        for name in _names(run_dir, folder):
            half = _HALF.fullmatch(name)
            if half is None or not pattern.fullmatch(half.group(1)):
                continue
            path = run_dir / folder / name
            if stat.S_ISREG(path.lstat().st_mode):
                path.unlink(missing_ok=True)


def _names(run_dir: Path, folder: str) -> list[str]:
    """Names in a folder of a run that is a folder itself, no link to one."""
    path = run_dir
    for part in Path(folder).parts:
        path = path / part
        mode = path.lstat().st_mode if os.path.lexists(path) else None
        if mode is None:
            return []
        if not stat.S_ISDIR(mode):
            raise RunError(
                f"{path}: is no folder, or a link to one. A run uses only what lies in "
                f"{run_dir}; put the folder itself there, or remove it."
            )
    with suppress(FileNotFoundError):
        return sorted(os.listdir(path))
    return []


@contextmanager
def new_run(
    run_dir: Path, recipe: str, prepare: Callable[[Path], None] | None = None
) -> Iterator[RunHold]:
    """Make the folder of a new run and hold it; nobody else may start one in it.

    The recipe, YAML, comes last: a folder with one is a run. ``prepare`` writes what
    else the run cannot do without, into the folder that it is given.

    Raises:
        RunError: it holds a run, another process is at it, or it cannot be written.
    """
    with reported(run_dir):
        run_dir.mkdir(parents=True, exist_ok=True)
    with hold_run(run_dir) as hold:
        check_run(run_dir)
        refuse_old_run(run_dir)  # another process may have just ended one
        with reported(run_dir):
            # loads torch, which what only reads a run can do without
            from flashdex.system.machine import versions

            write_object({"run": uuid.uuid4().hex, **versions()}, run_dir, VERSIONS)
            _keep_changes(run_dir)
            if prepare is not None:
                prepare(run_dir)
            write_recipe(run_dir, recipe)
        yield hold


@contextmanager
def resumed_run(run_dir: Path) -> Iterator[RunHold]:
    """Hold a run to go on with: its files are whole, what a crash left is removed.

    Raises:
        RunError: another process is at it, or a file is not as the run left it.
    """
    with hold_run(run_dir) as hold:
        check_run(run_dir)
        check_sessions(run_dir)
        with reported(run_dir):
            remove_temporaries(run_dir)
        yield hold


def write_recipe(run_dir: Path, recipe: str) -> None:
    """Store the recipe of a run, YAML, with its seal."""
    with open_own(run_dir, RECIPE) as file:
        file.write(seal_text(recipe).encode("utf-8"))


def _keep_changes(run_dir: Path) -> None:
    """Store what was not committed; a run does not need it."""
    try:
        from flashdex.system.machine import source_changes

        if diff := source_changes():
            with open_own(run_dir, DIFF) as file:
                file.write(diff)
    except OSError as error:
        _LOG.warning("%s is not written: %s", DIFF, error)


def refuse_old_run(run_dir: Path) -> None:
    """Refuse a folder that holds a run, or what is left of one, or cannot be made.

    Raises:
        RunError: it says which.
    """
    way = run_dir.absolute()
    place = next(p for p in (way, *way.parents) if os.path.lexists(p))
    if not (place.is_dir() and os.access(place, os.W_OK)):
        raise RunError(
            f"{run_dir}: cannot be written ({place} is no folder, or one that may not "
            "be changed). Choose another folder with run_dir=..."
        )
    left = [name for name in TRACES if os.path.lexists(run_dir / name)]
    if RECIPE in left:
        raise RunError(
            f"{run_dir}: already holds a run. Continue it with 'flashdex train "
            f"--resume {run_dir}', or choose another folder with run_dir=..."
        )
    if left:
        raise RunError(
            f"{run_dir}: holds files of a run without its {RECIPE} "
            f"({', '.join(left)}). Restore that (every checkpoint holds a copy), or "
            "choose another folder with run_dir=..."
        )


@contextmanager
def hold_run(run_dir: Path) -> Iterator[RunHold]:
    """Hold a folder as ``run_lock`` does; one that cannot be written is reported."""
    with ExitStack() as held:
        with reported(run_dir):
            hold = held.enter_context(run_lock(run_dir))
        yield hold


@contextmanager
def reported(run_dir: Path) -> Iterator[None]:
    """A folder that cannot be written is a mistake of the user."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{run_dir}: cannot be written ({error}). Make room, or choose another "
            f"folder with run_dir=... What is stored is whole; if {RECIPE} is there, "
            f"continue with 'flashdex train --resume {run_dir}'."
        ) from error


def seal_text(text: str) -> str:
    """A text whose last line, a comment, is the SHA-256 of those above it."""
    found = hashlib.sha256(text.encode("utf-8")).hexdigest()
    return f"{text}# sha256 of the lines above: {found}\n"


def read_recipe(run_dir: Path) -> str:
    """The recipe of a run as YAML, the seal left out.

    Raises:
        RunError: it is missing, damaged, or not as flashdex wrote it.
    """
    require_run(run_dir)
    text = read_own(run_dir, RECIPE) or ""
    body = text[: text.rfind("# sha256 of the lines above: ")]
    if seal_text(body) == text:
        return body
    raise RunError(
        f"{run_dir / RECIPE}: was changed or damaged since flashdex wrote it. Restore "
        "it (every checkpoint holds a copy), and give new values to --resume as "
        "key=value."
    )


def require_run(path: Path, *, or_library: bool = False) -> None:
    """Refuse a folder that holds no run, or, ``or_library``, no motion library either.

    Raises:
        RunError: it does not.
    """
    known = (RECIPE, MANIFEST) if or_library else (RECIPE,)
    if not any(os.path.lexists(path / name) for name in known):
        what = (
            "neither a run nor a motion library"
            if or_library
            else "not a run directory"
        )
        raise RunError(
            f"{path}: {what}, there is no "
            f"{' and no '.join(known)} in it. Give the "
            "folder that 'flashdex train' wrote, usually runs/<name>."
        )


def run_id(run_dir: Path) -> str:
    """What tells a run from every other one.

    Raises:
        RunError: the file that says so is missing, damaged, or of another version.
    """
    found = read_object(run_dir, VERSIONS).get("run")
    if isinstance(found, str) and _ID.fullmatch(found):
        return found
    raise RunError(
        f"{run_dir / VERSIONS}: does not say which run this is, as the 32 digits of "
        "'run'. Restore it from a copy. Runs of versions that gave none cannot be read "
        "any more; train again."
    )


def read_metrics(run_dir: Path) -> list[dict[str, Any]]:
    """Records of ``metrics.jsonl``: finite numbers only.

    Raises:
        RunError: a line is damaged, changed, or of something else.
    """
    path = own_file(run_dir, METRICS)
    records = read_lines(path, {"env_steps": float, "hours": float})
    for number, record in enumerate(records, start=1):
        for key, value in record.items():
            if type(value) not in (int, float) or not math.isfinite(value):
                raise RunError(
                    f"{path}: line {number} has {value!r:.60} as '{key}', which is no "
                    "finite number. Restore the file from a copy."
                )
    return records


def read_sessions(run_dir: Path) -> list[dict[str, Any]]:
    """Lines of ``sessions.jsonl``.

    Raises:
        RunError: a line is damaged, changed, or of something else.
    """
    path = own_file(run_dir, SESSIONS)
    lines = read_lines(path, {"event": str})
    for number, line in enumerate(lines, start=1):
        schema = STARTED if line["event"] == "start" else ENDED
        check_keys(line, schema, path, number)
        counts, words = line.get("lines", {}), line.get("overrides", [])
        check_keys(counts, dict.fromkeys(counts, int), path, number)
        named = {f"overrides[{i}]": word for i, word in enumerate(words)}
        check_keys(named, dict.fromkeys(named, str), path, number)
    return lines


def line_counts(run_dir: Path) -> dict[str, int]:
    """How many lines the files have that only grow while a session lasts."""
    paths = {name: own_file(run_dir, name) for name in (METRICS, CONVERSIONS)}
    return {name: len(read_lines(p)) for name, p in paths.items() if p.exists()}


def check_sessions(run_dir: Path, *, counts: bool = True) -> None:
    """Refuse a run whose other files are not those that its last session left.

    The seals of a file do not tell that lines at its end, or all of it, are gone.

    Args:
        run_dir: the folder.
        counts: look for lines that are missing, too.

    Raises:
        RunError: lines are missing, or ``versions.json`` is another run's.
    """
    lines = read_sessions(run_dir)
    own = run_id(run_dir)
    if any(x["event"] == "start" and x["run"] != own for x in lines):
        raise RunError(
            f"{run_dir / VERSIONS}: is not that of this run, or is missing. Restore it "
            "from a copy."
        )
    told = lines[-1].get("lines") if counts and lines else None
    now = line_counts(run_dir) if told else {}
    for name, count in (told or {}).items():
        missing = count - now.get(name, 0)
        if missing > 0:
            raise RunError(
                f"{run_dir / name}: {missing} lines are missing that were there when "
                "the last session ended. Restore the file from a copy."
            )
