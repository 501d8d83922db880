"""What the files of a run say of its attempts, against one another."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from flashdex.errors import FlashdexError
from flashdex.metrics.tally import (
    UNMOVED,
    Tally,
    count_faults,
    follow_misses,
    is_unmoved,
)
from flashdex.recipe import Recipe, RunRecipe, parse_recipe
from flashdex.recipe.reader import parse_yaml
from flashdex.recipe.store import DEFAULT_TASK, SEARCH_TASK
from flashdex.rollouts.findings import Notes, at, is_date
from flashdex.rollouts.ledger import (
    CONVERSIONS,
    line_faults,
    read_ledger,
)
from flashdex.rollouts.rollout import MADE_BY
from flashdex.system.files import own_file
from flashdex.system.jsonl import read_object
from flashdex.system.run_files import (
    BASELINES,
    METRICS,
    MOTIONS,
    RECIPE,
    SESSIONS,
    SOURCE,
    VERSIONS,
    line_counts,
    miss_name,
    read_metrics,
    read_recipe,
    read_sessions,
    rollout_name,
    run_id,
)

BASELINE_NAMES = ("do_nothing", "kinematic_playback", "frozen_object")
# of a recipe: what the baselines of a motion depend on
OF_BASELINES = ("hand", "motions", "physics", "env")
REASONS = ("budget", "all converted", "wall_limit_s", "signal", "error")
REASONS += ("nothing left to try",)  # of a search
SOURCES = {DEFAULT_TASK: "policy", SEARCH_TASK: "search"}
CLOCK = 1e-3  # s, to which lines round the clock of a run
Found = TypeVar("Found")


@dataclass(frozen=True)
class Era:
    """A recipe of a run, and the seconds of the run in which it was the recipe."""

    text: str
    since: float
    until: float
    recipe: RunRecipe | None  # None: it cannot be read here

    @property
    def sha256(self) -> str:
        """Of the recipe, as rollouts name it."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def holds(self, wall_s: float) -> bool:
        """Whether a line of that second may be of it."""
        return self.since - CLOCK <= wall_s <= self.until + CLOCK

    def is_like(self, other: Era, parts: Sequence[str]) -> bool:
        """Whether these parts of two recipes are the same."""
        return all(
            getattr(self.recipe, part, None) == getattr(other.recipe, part, None)
            for part in parts
        )

    @property
    def budget(self) -> float:
        """Env steps that it may come to, with those of the last vector step."""
        if not isinstance(self.recipe, Recipe) or self.recipe.task == SEARCH_TASK:
            return math.inf
        return self.recipe.total_env_steps + self.recipe.env.num_envs

    @cached_property
    def of_lines(self) -> dict[str, Any]:
        """What all lines of it have in common."""
        found = {
            "seed": at(self.plain, "seed"),
            "engine": at(self.plain, "physics", "engine"),
            "criterion": at(self.plain, "train", "criterion"),
            "source": SOURCES.get(at(self.plain, "task")),
        }
        return {key: value for key, value in found.items() if value is not None}

    @cached_property
    def plain(self) -> dict[str, Any]:
        """Keys and values of the recipe, known here or not."""
        try:
            return parse_yaml(self.text, where=RECIPE)
        except FlashdexError:
            return {}


class RunClaims(Notes):
    """The ledger, and what the other files say of it; ``lines`` checks them once."""

    def __init__(self, run_dir: Path) -> None:
        super().__init__(CONVERSIONS)
        self.run_dir = run_dir

    def _read(self, file: str, reader: Callable[[], Found], other: Found) -> Found:
        """What a reader finds; ``other``, and a fault, where it refuses the file."""
        try:
            return reader()
        except FlashdexError as error:
            self.fault("file", str(error), file=file)
            return other

    @cached_property
    def run(self) -> str:
        """Id of the run."""
        return self._read(VERSIONS, lambda: run_id(self.run_dir), "")

    @cached_property
    def made_by(self) -> dict[str, str]:
        """Versions that all rollouts were made by: of a run of one session."""
        found = self._read(VERSIONS, lambda: read_object(self.run_dir, VERSIONS), {})
        for name in MADE_BY:
            if not isinstance(found.get(name), str):
                self.fault("file", f"does not say which '{name}'", file=VERSIONS)
        starts = [x for x in self._sessions if x["event"] == "start"]
        names = {*MADE_BY} - {"engine"} if len(starts) == 1 else ()  # see the recipe
        return {name: str(found.get(name)) for name in names}

    @cached_property
    def eras(self) -> list[Era]:
        """Recipes of the run, oldest first; the last is that of ``recipe.yaml``."""
        text = self._read(RECIPE, lambda: read_recipe(self.run_dir), "")
        found = [Era(text, -1.0, math.inf, self._recipe(text))]
        if found[0].recipe is None:
            self.skip("recipe", "cannot be read here", file=RECIPE)
        starts = [x for x in self._sessions if x["event"] == "start"]
        for number, start in reversed(list(enumerate(starts, start=1))):
            before = after = found[0]
            if start["before"]:
                recipe, since = self._recipe(start["before"]), start["wall_s"]
                before = Era(start["before"], -1.0, since, recipe)
                found[:1] = [before, replace(after, since=since)]
            elif number == 1:
                continue  # what it was composed with
            words = start["overrides"]
            where = f"overrides of start {number}"
            if after.recipe is None or any("=~" in word for word in words):
                text = "of a recipe that cannot be read here, or of another home"
                self.skip(where, text, file=SESSIONS)
            elif after.recipe != self._recipe(before.text, words):
                text = "do not lead to the recipe that the run went on with"
                self.fault(where, text, file=SESSIONS)
        return found

    def _recipe(self, text: str, words: Sequence[str] = ()) -> RunRecipe | None:
        try:
            return parse_recipe(text, words, where=RECIPE)
        except FlashdexError:
            return None

    @cached_property
    def _starts(self) -> dict[str, Any]:
        """Lines of another run, by motion, at whose misses a search began."""
        found = self._read(SOURCE, lambda: read_object(self.run_dir, SOURCE), {})
        starts = found.get("starts")
        return starts if isinstance(starts, dict) else {}

    @cached_property
    def _same_motions(self) -> bool:
        """All recipes of the run select the same motions."""
        return all(era.is_like(self.eras[-1], ("motions",)) for era in self.eras)

    def era_of(self, recipe_sha256: Any) -> Era | None:
        """The newest era with a recipe of that hash."""
        found = [era for era in self.eras if era.sha256 == recipe_sha256]
        return found[-1] if found else None

    @cached_property
    def motions(self) -> dict[str, Any]:
        """Hash of each motion by name, as the run wrote them down."""
        found = self._read(MOTIONS, lambda: read_object(self.run_dir, MOTIONS), {})
        motions = found.get("motions")
        if not isinstance(motions, dict) or not motions:
            self.fault("motions", "names none", file=MOTIONS)
            return {}
        return motions

    def lines(self, names: Sequence[str] | None = None) -> list[dict[str, Any]]:
        """Lines of the ledger; one that is not as it was written ends the list.

        ``names`` of the motions that the recipe selects, where a library tells.
        """
        path, empty = own_file(self.run_dir, CONVERSIONS), list[dict[str, Any]]()
        lines = self._read(CONVERSIONS, lambda: read_ledger(path), empty)
        wall_s = core_s = 0.0
        misses: dict[str, dict[str, Any]] = {}
        for number, line in enumerate(lines, start=1):
            where = f"line {number}"
            if line["wall_s"] < wall_s:
                self.fault(where, "is out of order: its wall_s is below the one before")
            wall_s = line["wall_s"]
            self._line(where, line)
            near = self._starts.get(line["motion"]), misses.get(line["motion"])
            hashes = ["", *(at(x, "miss_sha256") for x in near)]
            if line.get("start", "") not in hashes:
                self.fault(where, "begins at no miss of its motion")
            follow_misses(misses, line)
            core_s += line.get("attempt_s", 0.0)
            if abs(line.get("core_s", core_s) - core_s) > CLOCK * number:
                self.fault(where, "core_s is not the sum of the attempts' core-seconds")
        if not self._sessions:
            self.fault("lines", "there are none", file=SESSIONS)
        self._clocks()
        self._proofs(lines)
        self._counts(lines, names)
        return lines

    def _line(self, where: str, line: dict[str, Any]) -> None:
        """What one line says of itself, of its session and of its motion."""
        eras = [era for era in self.eras if era.holds(line["wall_s"])]
        told = [line_faults(line, era.of_lines) for era in eras]
        for text in min(told, key=len, default=["is of no session"]):
            self.fault(where, text)
        named = line.get("rollout")
        if named and named != rollout_name(line["motion"]):
            self.fault(where, f"names {named!a}, not the rollout of its motion")
        miss = line.get("miss")
        if miss and (miss != miss_name(line["motion"]) or line["converted"]):
            self.fault(where, f"names {miss!a} as a miss, which it is not")
        if self.motions and line["motion"] not in self.motions:
            self.fault(where, f"'{line['motion']}' is no motion of {MOTIONS}")
        if line["gpu_s"] not in (0.0, line["wall_s"]):
            self.fault(where, f"gpu_s is {line['gpu_s']}, wall_s {line['wall_s']}")
        if line["converted"] != (line["criterion"] in line["passed"]):
            self.fault(where, "converted is not what the passed criteria say")
        if named and not line["converted"]:
            self.fault(where, "names a rollout of an attempt that did not pass")
        expected = self._baselines.get((line["motion"], line["criterion"]), [])
        if [b for b in line["trivial"] if b != UNMOVED] != expected:
            text = f"trivial is {line['trivial']}, by the baselines {expected}"
            if any(era.is_like(self.eras[-1], OF_BASELINES) for era in eras):
                self.fault(where, text)
            else:
                text = "of lines by an earlier recipe, whose baselines are not kept"
                self.skip("trivial", text)

    def _proofs(self, lines: list[dict[str, Any]]) -> None:
        """A motion is converted by the line that stores its first pass."""
        kept: dict[tuple[str, str], bool] = {}  # whether the object moved in one
        for number, line in enumerate(lines, start=1):
            key = (line["motion"], line["criterion"])
            if line.get("rollout"):
                kept[key] = kept.get(key, False) or not is_unmoved(line)
            elif line.get("certified") or line.get("verdict"):
                self.fault(f"line {number}", "is certified, but names no rollout")
            elif line["converted"] and not (
                key in kept and (kept[key] or is_unmoved(line))
            ):
                text = "is the motion's first conversion, but names no rollout"
                self.fault(f"line {number}", text)

    def _counts(self, lines: list[dict[str, Any]], names: Sequence[str] | None) -> None:
        """Conversions that the metrics count, against the lines of each era."""
        records = self._records
        for key in ("hours", "env_steps"):
            values = [0.0, *(record[key] for record in records)]
            if values != sorted(values):
                self.fault("records", f"{key} go back", file=METRICS)
        budgets = [era.budget for era in self.eras]
        if records and records[-1]["env_steps"] > max(budgets):
            text = f"go to {records[-1]['env_steps']:g} env steps, beyond the budget"
            self.fault("records", text, file=METRICS)
        last = self.eras[-1]
        for era in self.eras:
            own = [r for r in records if era.since < r["hours"] * 3600 <= era.until]
            motions = names if era is last and names is not None else None
            motions = list(self.motions) if self._same_motions else motions
            criterion = era.of_lines.get("criterion")
            if not motions or criterion is None:
                text = "of an era whose motions are not known: a resume chose others"
                self.skip("counts", text, file=METRICS)
                continue
            counted = [
                x
                for x in lines
                if x["criterion"] == criterion
                and x["motion"] in motions
                and x["wall_s"] <= era.until + CLOCK
            ]
            is_whole = era is last and self._ended
            tally = Tally(motions, criterion)
            for text in count_faults(own, counted, tally, is_whole=is_whole):
                self.fault("counts", text, file=METRICS)

    @cached_property
    def _records(self) -> list[dict[str, Any]]:
        return self._read(METRICS, lambda: read_metrics(self.run_dir), [])

    @cached_property
    def _ended(self) -> bool:
        """The last session ended in order, and so counted all its attempts."""
        last = self._sessions[-1:]
        return any(x["event"] == "end" and x["why"] != "error" for x in last)

    def _clocks(self) -> None:
        """Sessions follow one another, and an ended one left as many lines as it says.

        That lines are missing is told by ``check_sessions``, at a resume as well.
        """
        wall_s, before = 0.0, "end"
        for number, line in enumerate(self._sessions, start=1):
            where = f"line {number}"
            if before == line["event"] == "end":
                self.fault(where, "ends a session that did not begin", file=SESSIONS)
            before = line["event"]
            if before == "start" and line["run"] != self.run:
                self.fault(where, f"is of another run than {VERSIONS}", file=SESSIONS)
            if before == "end" and line["why"] not in REASONS:
                text = f"ended by {line['why']!a:.40}, which is no reason"
                self.fault(where, text, file=SESSIONS)
            if line["wall_s"] < wall_s:
                self.fault(where, "begins before the one above it ended", file=SESSIONS)
            wall_s = line["wall_s"]
            if not is_date(line["date"]):
                self.fault(where, f"{line['date']!a:.40} is no date", file=SESSIONS)
        last: dict[str, Any] = (self._sessions or [{"event": ""}])[-1]
        if self._ended and self._records:
            steps = self._records[-1]["env_steps"]
            if steps != last["env_steps"]:
                text = f"env_steps are {last['env_steps']}, {steps:g} of {METRICS}"
                self.fault("end", text, file=SESSIONS)
        if last["event"] == "end":
            told = last["lines"]
            now = self._read(SESSIONS, lambda: line_counts(self.run_dir), told)
            for name in {*told, *now}:
                if told.get(name) != now.get(name):
                    text = f"{now.get(name)} lines, {told.get(name)} by the session"
                    self.fault("lines", text, file=name)

    def is_of_session(self, date: Any) -> bool:
        """Whether some session lasted at a moment, to a day."""
        dates = [x["date"] for x in self._sessions]
        if not all(map(is_date, [date, *dates])):
            return False
        moment, *moments = map(datetime.fromisoformat, [date, *dates])
        day = timedelta(days=1)
        begun = [m for m in moments if m - day <= moment]
        later = [m for m in moments if moment <= m + day]
        return bool(begun) and (bool(later) or not self._ended)

    @cached_property
    def _baselines(self) -> dict[tuple[str, str], list[str]]:
        """Baselines by motion and criterion that they pass."""
        rows = self._read(BASELINES, lambda: read_object(self.run_dir, BASELINES), {})
        found: dict[tuple[str, str], list[str]] = {}
        for name in rows.keys() - {*BASELINE_NAMES}:
            self.fault(name[:60], "is no baseline", file=BASELINES)
        for name in BASELINE_NAMES:
            for motion in self.motions:
                passed = at(rows, name, motion, "passed")
                if not isinstance(passed, list):
                    if self._same_motions:
                        self.fault(name, f"no score of '{motion}'", file=BASELINES)
                    passed = []
                for criterion in map(str, passed):
                    found.setdefault((motion, criterion), []).append(name)
        return found

    @cached_property
    def _sessions(self) -> list[dict[str, Any]]:
        return self._read(SESSIONS, lambda: read_sessions(self.run_dir), [])
