"""What the files of a run say of its attempts, against one another."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any

from flashdex.errors import FlashdexError, RunError
from flashdex.metrics.tally import UNMOVED, Tally, is_unmoved
from flashdex.recipe.reader import parse_yaml
from flashdex.rollouts.findings import Finding, at
from flashdex.rollouts.ledger import (
    CONVERSIONS,
    count_faults,
    line_faults,
    read_ledger,
    rollout_name,
)
from flashdex.system.files import own_file
from flashdex.system.jsonl import read_object
from flashdex.system.run_files import (
    BASELINES,
    MOTIONS,
    RECIPE,
    SESSIONS,
    VERSIONS,
    read_metrics,
    read_recipe,
    read_sessions,
    run_id,
)

BASELINE_NAMES = ("do_nothing", "kinematic_playback", "frozen_object")
MAX_JSON = 16 << 20  # bytes of a certificate


class RunClaims:
    """The ledger, and what the other files say of it; ``lines`` checks them once."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.findings: list[Finding] = []

    def fault(self, what: str, text: str, *, file: str = CONVERSIONS) -> None:
        """Note a difference."""
        self.findings.append(Finding(file, what, text))

    @cached_property
    def is_bound(self) -> bool:
        """It has an id: all that older versions did not bind is bound in it."""
        try:
            return bool(run_id(self.run_dir))
        except RunError:
            return True

    @cached_property
    def of_run(self) -> dict[str, Any]:
        """What all lines of a run have in common, as far as its files say."""
        try:
            recipe = parse_yaml(read_recipe(self.run_dir), where=RECIPE)
            versions = read_object(self.run_dir, VERSIONS)
        except FlashdexError:
            return {}
        found = {"seed": recipe.get("seed")}
        if not self.was_overridden():
            found["engine"] = versions.get("engine")
            found["criterion"] = at(recipe, "train", "criterion")
        return {key: value for key, value in found.items() if value is not None}

    @cached_property
    def motions(self) -> dict[str, Any]:
        """Hash of each motion by name, as the run wrote them down."""
        try:
            found = read_object(self.run_dir, MOTIONS).get("motions", {})
        except RunError as error:
            self.fault("file", str(error), file=MOTIONS)
            return {}
        if not isinstance(found, dict) or (self.is_bound and not found):
            self.fault("motions", "names none", file=MOTIONS)
            return {}
        return found

    def lines(self) -> list[dict[str, Any]]:
        """Lines of the ledger; one that is not as it was written ends the list."""
        try:
            lines = read_ledger(own_file(self.run_dir, CONVERSIONS))
        except FlashdexError as error:
            self.fault("lines", str(error))
            return []
        attempts, wall_s = self._attempts(), 0.0
        if len(lines) < attempts:
            self.fault("lines", f"{len(lines)} are left of {attempts} attempts")
        if len(lines) > attempts and self._is_over():
            self.fault("lines", f"{len(lines)} of {attempts} attempts")
        for number, line in enumerate(lines, start=1):
            where = f"line {number}"
            if line["wall_s"] < wall_s:
                self.fault(where, "is out of order: its wall_s is below the one before")
            wall_s = line["wall_s"]
            self._line(where, line)
            if not self.is_bound:
                continue
            for text in line_faults(line, self.of_run):
                self.fault(where, text)
            if self.motions and line["motion"] not in self.motions:
                self.fault(where, f"'{line['motion']}' is no motion of {MOTIONS}")
        if lines and self.is_bound and not self._sessions:
            self.fault("lines", "there are none", file=SESSIONS)
        self._proofs(lines)
        self._counts(lines)
        return lines

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

    def _counts(self, lines: list[dict[str, Any]]) -> None:
        """Conversions that the metrics count, against the lines."""
        # an override counts other motions, or by another criterion
        if not self.is_bound or not self.motions or self.was_overridden():
            return
        if self._metrics is None:
            return
        tally = Tally(self.motions, self.of_run.get("criterion", ""))
        for text in count_faults(self._metrics, lines, tally):
            self.fault("counts", text, file="metrics.jsonl")

    @cached_property
    def _metrics(self) -> list[dict[str, Any]] | None:
        """Records of the metrics; None, and a fault, where they cannot be read."""
        try:
            return read_metrics(self.run_dir)
        except RunError as error:
            self.fault("metrics", str(error), file="metrics.jsonl")
            return None

    def _attempts(self) -> int:
        """Attempts that the last record of the metrics counts."""
        records = self._metrics
        return int(records[-1].get("convert/attempts", 0)) if records else 0

    @cached_property
    def baselines(self) -> dict[tuple[str, str], list[str]] | None:
        """Baselines by motion and criterion that they pass; None: not comparable."""
        path = own_file(self.run_dir, BASELINES)
        # an override scores them anew, for the lines from then on
        if self.was_overridden():
            return None
        if not path.is_file():
            if self.is_bound:
                self.fault("file", "is missing", file=path.name)
            return None
        rows, fault = read_json(path)
        if fault:
            self.fault("file", fault, file=path.name)
            return None
        for name in BASELINE_NAMES if self.is_bound else ():
            for motion in self.motions:
                if not isinstance(at(rows, name, motion, "passed"), list):
                    self.fault(name, f"no score of '{motion}'", file=path.name)
        found: dict[tuple[str, str], list[str]] = {}
        for name, motions in rows.items():
            for motion in motions if isinstance(motions, dict) else ():
                for criterion in at(motions, motion, "passed") or ():
                    found.setdefault((motion, criterion), []).append(name)
        return found

    def _line(self, where: str, line: dict[str, Any]) -> None:
        """What one line says of itself."""
        named = line.get("rollout")
        if named and named != rollout_name(line["motion"]):
            self.fault(where, f"names {named!a}, not the rollout of its motion")
        if line.get("gpu_s", 0.0) not in (0.0, line["wall_s"]):
            self.fault(where, f"gpu_s is {line['gpu_s']}, wall_s {line['wall_s']}")
        if line["converted"] != (line["criterion"] in line.get("passed", [])):
            self.fault(where, "converted is not what the passed criteria say")
        if self.baselines is not None and "trivial" in line:
            expected = self.baselines.get((line["motion"], line["criterion"]), [])
            if [b for b in line["trivial"] if b != UNMOVED] != expected:
                text = f"trivial is {line['trivial']}, by the baselines {expected}"
                self.fault(where, text)
        if named and not line["converted"]:
            self.fault(where, "names a rollout of an attempt that did not pass")

    def was_overridden(self) -> bool:
        """A later session than the first was given other values."""
        starts = [x for x in self._sessions if x.get("event") == "start"]
        return any(session.get("overrides") for session in starts[1:])

    def _is_over(self) -> bool:
        """The last session ended in order, and so counted all its attempts."""
        last = self._sessions[-1:]
        ended = any(x.get("event") == "end" and x.get("why") != "error" for x in last)
        return ended and not self.was_overridden()

    @cached_property
    def _sessions(self) -> list[dict[str, Any]]:
        try:
            return read_sessions(self.run_dir)
        except RunError:
            return []


def read_json(file: Path) -> tuple[dict[str, Any], str]:
    """A JSON object, or why it is none."""
    try:
        if file.stat().st_size > MAX_JSON:
            return {}, f"{file.stat().st_size} bytes are no certificate"
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        return {}, f"is no JSON ({error})"
    return (found, "") if isinstance(found, dict) else ({}, "is no JSON object")
