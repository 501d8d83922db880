"""Sessions of a run: where one begins, what a crash cost, and what ends one."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from flashdex.algorithms import find_algorithm
from flashdex.errors import RunError
from flashdex.recipe import RunRecipe, dump_recipe
from flashdex.recipe.reader import parse_yaml
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.system.files import own_file
from flashdex.system.jsonl import append_line, drop_cut_line, read_lines
from flashdex.system.run_files import (
    SESSIONS,
    line_counts,
    read_metrics,
    read_sessions,
    run_id,
)

_LOG = logging.getLogger(__name__)
LABELS = ("name", "ablation", "seed", "run_dir")  # of the records so far
SIGNAL = "signal"  # why a session ended, when a person or a scheduler ended it


@dataclass(frozen=True)
class SessionStart:
    """Where a session begins."""

    env_steps: int  # of the checkpoint, 0 without one
    wall_s: float  # s of the run so far, those after the checkpoint included
    lost: int  # env steps of all sessions that no checkpoint kept
    run: str  # what tells the run from others


def begin_session(
    run_dir: Path,
    *,
    env_steps: int,
    wall_s: float,
    overrides: list[str],
    before: str = "",
) -> SessionStart:
    """Work out where a session begins and write its ``start`` line.

    The counters go back to the checkpoint. The clock does not: it goes on from the
    latest moment that any file of the run knows of. Env steps beyond the checkpoint
    were simulated for nothing and are added up. ``before`` is the recipe, YAML, that
    the overrides change.
    """
    path = own_file(run_dir, SESSIONS)
    drop_cut_line(path)
    starts = [s for s in read_sessions(run_dir) if s["event"] == "start"]
    since = starts[-1]["wall_s"] if starts else 0.0
    seen = _seen(run_dir)
    # What an earlier resume has counted already was written before that resume.
    reached = [steps for steps, wall in seen if wall > since]
    lost = max(0, max(reached, default=0) - env_steps)
    start = SessionStart(
        env_steps=env_steps,
        wall_s=max([wall_s, since, *(wall for _, wall in seen)]),
        lost=lost + (starts[-1]["env_steps_lost"] if starts else 0),
        run=run_id(run_dir),
    )
    line = {
        "event": "start",
        "date": _now(),
        "env_steps": env_steps,
        "wall_s": start.wall_s,
        "env_steps_lost": start.lost,
        "overrides": overrides,
        "run": start.run,
        "before": before,
    }
    append_line(path, line)
    return start


def end_session(run_dir: Path, why: str, *, env_steps: int, wall_s: float) -> None:
    """Write the ``end`` line; a session without one crashed, or is running."""
    counters = {"env_steps": env_steps, "wall_s": wall_s}
    line = {"event": "end", "date": _now(), **counters, "why": why}
    line["lines"] = line_counts(run_dir)
    append_line(own_file(run_dir, SESSIONS), line)


def ended_by(run_dir: Path) -> str:
    """Why the newest session ended, empty when it has not."""
    lines = read_sessions(run_dir)
    return lines[-1].get("why", "") if lines else ""


def _seen(run_dir: Path) -> list[tuple[int, float]]:
    """Env steps and clock, s, of every record of a run."""
    metrics = read_metrics(run_dir)
    out = [(int(r["env_steps"]), 3600.0 * r["hours"]) for r in metrics]
    lines = read_lines(run_dir / CONVERSIONS)
    out += [(int(r["env_steps"]), float(r["wall_s"])) for r in lines]
    ends = [s for s in read_sessions(run_dir) if s["event"] == "end"]
    return out + [(int(s["env_steps"]), float(s["wall_s"])) for s in ends]


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def stored_value(text: str, key: str) -> Any:
    """Value of a recipe, YAML, None where it has no such key.

    Example:
        >>> stored_value("algo: {v_max: 5.0}", "algo.v_max")
        5.0
    """
    found: Any = parse_yaml(text, where="the recipe of a checkpoint")
    for word in key.split("."):
        found = found.get(word) if isinstance(found, dict) else None
    return found


def refuse_changes(text: str, recipe: RunRecipe) -> None:
    """Refuse a recipe under which the run would be another algorithm.

    Raises:
        RunError: one message with every value that differs.
    """
    present = dump_recipe(recipe)
    algorithm = find_algorithm(stored_value(text, "algo.kind"))
    changed = []
    for key in (*LABELS, *algorithm.immutable_keys):
        was, now = stored_value(text, key), stored_value(present, key)
        if was != now:
            changed.append(f"{key} from {was} to {now}")
    if changed:
        raise RunError(
            f"these cannot change in a running run: {', '.join(changed)}; start a new "
            "run"
        )


class StopSignals:
    """Notes Ctrl-C, SIGTERM and a closed terminal, for the loop to act on.

    A second Ctrl-C raises KeyboardInterrupt where it falls. A second SIGTERM does
    nothing: schedulers repeat it, and it must not cost the checkpoint being written.
    With ``at_once`` the first Ctrl-C raises, and nothing else is noted.

    Example:
        >>> with StopSignals() as stop:
        ...     stop.requested
        False
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self.requested, self.at_once = False, at_once
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        names = [signal.SIGINT, signal.SIGTERM]
        if self.at_once:  # the others end the process, as ever
            self._before = {signal.SIGINT: signal.signal(signal.SIGINT, self._note)}
            return self
        hangup = getattr(signal, "SIGHUP", None)
        # nohup ignores it, and is taken at its word
        if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:
            names.append(hangup)
        self._before = {n: signal.signal(n, self._note) for n in names}
        return self

    def __exit__(self, *error: object) -> None:
        for name, handler in self._before.items():
            signal.signal(name, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.at_once or (self.requested and number == signal.SIGINT):
            self.requested = True
            raise KeyboardInterrupt
        if not self.requested:
            _LOG.info("stopping after this step; Ctrl-C again stops at once")
        self.requested = True


@contextmanager
def interruptible() -> Iterator[None]:
    """End a block without a loop on Ctrl-C, at the latest where it is left.

    The exception falls anywhere, also into a callback of a library that drops it.
    """
    with StopSignals(at_once=True) as stop:
        yield
    if stop.requested:
        raise KeyboardInterrupt
