"""Sessions of a run: where one begins, what a crash cost, and what ends one."""

from __future__ import annotations

import logging
import signal
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
from flashdex.system.jsonl import append_line, drop_cut_line, read_lines
from flashdex.training.logging import METRICS

_LOG = logging.getLogger(__name__)
SESSIONS = "sessions.jsonl"
LABELS = ("name", "ablation", "seed", "run_dir")  # of the records so far
SIGNAL = "signal"  # why a session ended, when a person or a scheduler ended it


@dataclass(frozen=True)
class SessionStart:
    """Where a session begins."""

    env_steps: int  # of the checkpoint, 0 without one
    wall_s: float  # s of the run so far, those after the checkpoint included
    lost: int  # env steps of all sessions that no checkpoint kept


def begin_session(
    run_dir: Path, *, env_steps: int, wall_s: float, overrides: list[str]
) -> SessionStart:
    """Work out where a session begins and write its ``start`` line.

    The counters go back to the checkpoint. The clock does not: it goes on from the
    latest moment that any file of the run knows of. Env steps beyond the checkpoint
    were simulated for nothing and are added up.
    """
    drop_cut_line(run_dir / SESSIONS)
    before = [s for s in read_lines(run_dir / SESSIONS) if s["event"] == "start"]
    since = before[-1]["wall_s"] if before else 0.0
    seen = _seen(run_dir)
    # What an earlier resume has counted already was written before that resume.
    reached = [steps for steps, wall in seen if wall > since]
    lost = max(0, max(reached, default=0) - env_steps)
    start = SessionStart(
        env_steps=env_steps,
        wall_s=max([wall_s, since, *(wall for _, wall in seen)]),
        lost=lost + (before[-1]["env_steps_lost"] if before else 0),
    )
    line = {
        "event": "start",
        "date": _now(),
        "env_steps": env_steps,
        "wall_s": start.wall_s,
        "env_steps_lost": start.lost,
        "overrides": overrides,
    }
    append_line(run_dir / SESSIONS, line)
    return start


def end_session(run_dir: Path, why: str, *, env_steps: int, wall_s: float) -> None:
    """Write the ``end`` line; a session without one crashed, or is running."""
    counters = {"env_steps": env_steps, "wall_s": wall_s}
    line = {"event": "end", "date": _now(), **counters, "why": why}
    append_line(run_dir / SESSIONS, line)


def ended_by(run_dir: Path) -> str:
    """Why the newest session ended, empty when it has not."""
    lines = read_lines(run_dir / SESSIONS)
    return lines[-1].get("why", "") if lines else ""


def _seen(run_dir: Path) -> list[tuple[int, float]]:
    """Env steps and clock, s, of every record of a run."""
    metrics: list[dict[str, Any]] = read_lines(run_dir / METRICS)
    out = [(int(r["env_steps"]), 3600.0 * r["hours"]) for r in metrics]
    lines = read_lines(run_dir / CONVERSIONS)
    out += [(int(r["env_steps"]), float(r["wall_s"])) for r in lines]
    ends = [s for s in read_lines(run_dir / SESSIONS) if s["event"] == "end"]
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

    Example:
        >>> with StopSignals() as stop:
        ...     stop.requested
        False
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        names = [signal.SIGINT, signal.SIGTERM]
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
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not self.requested:
            _LOG.info("stopping after this step; Ctrl-C again stops at once")
        self.requested = True
