"""What a run says about each motion: the rows behind every table."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any

from flashdex.errors import RecipeError, RunError, UnknownNameError
from flashdex.keys import SIDES
from flashdex.metrics.criteria_table import Term, make_criteria, resolve_criterion
from flashdex.recipe.reader import parse_yaml
from flashdex.system.files import own_files
from flashdex.system.jsonl import Schema, read_lines, read_object
from flashdex.system.run_files import (
    BASELINES,
    CONVERSIONS,
    RECIPE,
    ROLLOUTS,
    SOURCE,
    VERSIONS,
    check_run,
    check_sessions,
    read_metrics,
    read_recipe,
)

Line = dict[str, Any]
ATTEMPT: Schema = {
    "motion": str,
    "converted": bool,
    "errors": dict,
    "env_steps": int,
    "wall_s": float,
}


@dataclass(frozen=True)
class RunData:
    """The files of a run, as plain data."""

    path: Path  # run directory
    recipe: Line  # composed recipe
    versions: Line  # package versions, and hardware when it was recorded
    # records of ``metrics.jsonl``; what a resumed run did again is left out
    metrics: list[Line]
    attempts: list[Line]  # lines of ``conversions.jsonl``, oldest first
    baselines: dict[str, dict[str, Line]]  # baseline -> motion -> score
    certificates: dict[str, Line]  # motion -> certificate, of stored rollouts
    # motions that the run converted which a search goes on from, and are left out
    before: frozenset[str] = frozenset()

    @property
    def criterion(self) -> str:
        """Name of the criterion that counts as a conversion."""
        return str(self.recipe.get("train", {}).get("criterion", "sr_mt_obj"))

    @property
    def ablation(self) -> str:
        """Name of the ablation, empty without one."""
        name = str(self.recipe.get("ablation") or "none")
        return "" if name == "none" else name

    @property
    def env_steps(self) -> int:
        """Env steps so far."""
        lines = [*self.metrics[-1:], *self.attempts[-1:]]
        return int(max((line.get("env_steps", 0) for line in lines), default=0))

    @property
    def wall_s(self) -> float:
        """Seconds of training so far, earlier sessions included."""
        hours = self.metrics[-1].get("hours", 0.0) if self.metrics else 0.0
        last = self.attempts[-1].get("wall_s", 0.0) if self.attempts else 0.0
        return max(3600.0 * hours, last)


def load_run(run_dir: str | Path) -> RunData:
    """Read the folder that has a ``recipe.yaml``.

    Raises:
        RunError: this is no run directory, or a file in it is broken.
    """
    path = Path(run_dir)
    text = read_recipe(path)  # refuses what is none, or was changed
    check_run(path)
    check_sessions(path)
    versions = read_object(path, VERSIONS)
    versions.pop("run", None)  # its id, for machines
    try:
        composed = parse_yaml(text, where=str(path / RECIPE))
    except RecipeError as error:
        raise RunError(f"{error}\nRestore the file.") from error
    return RunData(
        path=path,
        recipe=composed,
        versions=versions,
        metrics=_drop_repeated(read_metrics(path)),
        attempts=read_lines(path / CONVERSIONS, ATTEMPT),
        baselines=_baselines(path),
        certificates=_certificates(path),
        before=frozenset(_converted_before(path)),
    )


def _converted_before(path: Path) -> Line:
    found = read_object(path, SOURCE).get("converted", {})
    if not isinstance(found, dict):
        raise RunError(
            f"{path / SOURCE}: names no conversions. Restore it from a copy."
        )
    return found


def _baselines(path: Path) -> dict[str, dict[str, Line]]:
    """Scores by baseline and motion.

    Raises:
        RunError: the file says something else.
    """
    found = read_object(path, BASELINES)
    rows = [
        row
        for motions in found.values()
        if isinstance(motions, dict)
        for row in motions.values()
    ]
    if not all(isinstance(m, dict) for m in found.values()) or not all(
        isinstance(row, dict)
        and isinstance(row.get("errors", {}), dict)
        and all(type(v) in (int, float) for v in row.get("errors", {}).values())
        for row in rows
    ):
        raise RunError(
            f"{path / BASELINES}: holds no scores of baselines. Restore or remove it."
        )
    return found


def _drop_repeated(records: list[Line]) -> list[Line]:
    """Keep records whose env steps no later record has reached again."""
    kept: list[Line] = []
    for record in reversed(records):
        if not kept or record.get("env_steps", 0) < kept[-1].get("env_steps", 0):
            kept.append(record)
    return kept[::-1]


def _certificates(run_dir: Path) -> dict[str, Line]:
    found = {}
    for path in own_files(run_dir, ROLLOUTS, "*.certificate.json"):
        certificate = read_object(run_dir, ROLLOUTS, path.name, sealed=False)
        identity = certificate.get("identity")
        name = identity.get("motion") if isinstance(identity, dict) else None
        found[str(name or path.name.removesuffix(".certificate.json"))] = certificate
    return found


PROVEN = ("certified", "robust")
STRICT = "sr_mt_obj_x0.5"  # stands beside the criterion of the run in every table
# quantity -> (heading, unit, factor from m or rad)
SHOWN = {
    "object_pos": ("object", "mm", 1e3),
    "object_pos_centred": ("object centred", "mm", 1e3),
    "object_rot": ("object", "deg", 57.29577951308232),
    "lift": ("lift off by", "x", 1.0),
    "path": ("path off by", "x", 1.0),
    "fingertip": ("fingertips", "mm", 1e3),
    "joint": ("joints", "mm", 1e3),
    "wrist_pos": ("wrists", "mm", 1e3),
}


@dataclass(frozen=True)
class MotionFacts:
    """One row of the per-motion table: what the files of a run say about a motion."""

    run: RunData  # the files
    name: str  # motion id
    lines: list[Line]  # of the ledger, scored rollouts from frame 0, oldest first

    @cached_property
    def baselines(self) -> dict[str, Line]:
        """Score of this motion by baseline."""
        scores = self.run.baselines.items()
        return {b: rows[self.name] for b, rows in scores if self.name in rows}

    @cached_property
    def first(self) -> Line | None:
        """Ledger line of the first conversion; one that is not trivial, if any."""
        passed = [line for line in self.lines if line.get("converted")]
        real = (line for line in passed if not line.get("trivial"))
        return next(real, passed[0] if passed else None)

    @property
    def ratios(self) -> tuple[float | None, float | None]:
        """Lift and path of the object over those of the recording, of ``errors``."""
        line = self.first or self._best or {}
        return line.get("lift_ratio"), line.get("path_ratio")

    @cached_property
    def _best(self) -> Line | None:
        found = [line for line in self.lines if line.get("errors")]
        return min(found, key=lambda line: _error_size(line["errors"]), default=None)

    @property
    def is_converted(self) -> bool:
        """At least one attempt passed."""
        return self.first is not None

    @cached_property
    def errors(self) -> dict[str, float]:
        """Of the first conversion, else of the best complete attempt; m and rad."""
        return (self.first or self._best or {}).get("errors", {})

    @property
    def hands(self) -> tuple[str, ...]:
        """Hands that a criterion or a cause names: an absent hand has neither."""
        found: set[str] = set()
        for line in [*self.lines, *self.baselines.values()]:
            found.update(line.get("hands", []))
            found.update(hand for _, hand in _why(line))
            found.update(name.rpartition("_")[2] for name in line.get("passed", []))
        return tuple(side for side in SIDES if side in found)

    @property
    def trivial(self) -> list[str]:
        """Why a conversion counts for little: baselines that pass, hardly a motion."""
        scores = self.baselines.items()
        criterion = self.run.criterion
        passing = [b for b, row in scores if criterion in row.get("passed", [])]
        named = (self.first or {}).get("trivial") or []
        return list(dict.fromkeys([*passing, *named]))

    @property
    def certificate(self) -> Line:
        """Of the stored rollout, which counts only where the ledger claims it."""
        return self.run.certificates.get(self.name, {}) if self.first else {}

    @property
    def verdict(self) -> str:
        """Word of the certificate; ``none`` for a conversion without one."""
        if self.first is None:
            return ""
        found = self.certificate.get("verdict") or self.first.get("verdict")
        return str(found or "none")

    @property
    def proof(self) -> tuple[float | None, float | None, float | None]:
        """Share of perturbed replays that passed; nominal: depth, mm, and force, N."""
        name = self.certificate.get("identity", {}).get("criterion")
        shares = self.certificate.get("perturbed", {}).get("pass_fraction", {})
        safety = self.certificate.get("safety", {})
        peaks = (safety.get(key) for key in ("penetration_max_mm", "force_peak"))
        return shares.get(name), *peaks

    @property
    def strict(self) -> tuple[bool | None, float | None]:
        """Nominal replay: within half the limits? Largest object error of any frame, m.

        None where it was not replayed, or by a version that did not say.
        """
        nominal = self.certificate.get("nominal", {})
        state = nominal.get(STRICT, {}).get("state")
        frame = nominal.get("sr_mt_obj_frame", {}).get("values", {})
        passed = None if state in (None, "not_measured") else state == "passed"
        return passed, frame.get("object_pos")

    @property
    def failures(self) -> str:
        """Most frequent cause of failure with its share of the failed attempts.

        And how far the motion came, if no attempt reached its end.
        """
        if not self.lines:
            is_before = self.name in self.run.before
            return "converted by the run before" if is_before else "not attempted"
        failed = [line for line in self.lines if not line.get("converted")]
        causes = Counter(cause for line in failed for cause in _why(line))
        why = ""
        for (cause, hand), times in causes.most_common(1):
            share = f"{times / len(failed):.0%}"
            why = " ".join(word for word in (cause, hand, share) if word)
        if self.is_converted or any(line.get("completed") for line in self.lines):
            return why
        furthest = max(line.get("frame", -1) for line in self.lines)
        return f"{why}; never completed, furthest frame {furthest}"


def motion_facts(run: RunData) -> list[MotionFacts]:
    """Rows of all motions the files name, in the order of the collection."""
    scored = (m for rows in run.baselines.values() for m in rows)
    names = dict.fromkeys([*scored, *(line["motion"] for line in run.attempts)])
    lines: dict[str, list[Line]] = {name: [] for name in names}
    for line in run.attempts:
        lines[line["motion"]].append(line)
    return [MotionFacts(run, name, found) for name, found in lines.items()]


def _why(line: Line) -> set[tuple[str, str]]:
    """Causes of one attempt, each counted once."""
    return {
        (str(w.get("cause", "")), str(w.get("hand", ""))) for w in line.get("why", [])
    }


def _error_size(errors: dict[str, float]) -> float:
    """Object error: 30 degrees weigh as much as 3 cm, as in the ledger."""
    return errors.get("object_pos", 9.0) + 0.0573 * errors.get("object_rot", 9.0)


def criterion_terms(criterion: str) -> tuple[Term, ...]:
    """Signals and limits of a criterion; empty for one this version does not know."""
    try:
        name = resolve_criterion(criterion)
    except UnknownNameError:
        return ()
    return next((c.terms for c in make_criteria() if c.name == name), ())


def num_motions(run: RunData, facts: list[MotionFacts]) -> int:
    """Motions of the collection; those without baseline and attempt are counted too."""
    for record in reversed(run.metrics):
        rate = record.get("convert/rate", 0.0)
        if rate > 0:
            return max(len(facts), round(record["convert/cumulative"] / rate))
    return len(facts)


def count(facts: list[MotionFacts]) -> dict[str, int]:
    """Conversions that are not trivial, how many of them hold, and trivial ones."""
    passed = [f for f in facts if f.is_converted]
    converted = [f for f in passed if not f.trivial]
    return {
        "converted": len(converted),
        "certified": sum(f.verdict in PROVEN for f in converted),
        "robust": sum(f.verdict == "robust" for f in converted),
        "strict": sum(f.strict[0] is True for f in converted),
        "trivial": len(passed) - len(converted),
        "attempts": sum(len(f.lines) for f in facts),
    }


def world_of(recipe: Line) -> str:
    """The settings that a conversion hangs on most, of a composed recipe.

    Example:
        >>> world_of({"physics": {"friction": 1.0, "object_friction": 0.5}})
        'friction 1 hand, 0.5 object'
    """
    physics = recipe.get("physics", {})
    parts = (("hand", "friction"), ("object", "object_friction"))
    parts += (("support", "support_friction"), ("m spin", "torsional_friction"))
    found = [f"{physics[key]:g} {name}" for name, key in parts if key in physics]
    return f"friction {', '.join(found)}" if found else ""


def peaks(facts: list[MotionFacts]) -> dict[str, tuple[float, float]]:
    """Median and maximum over the replays of conversions: mm deep, and N."""
    found = {}
    for place, name in ((1, "penetration_mm"), (2, "force_n")):
        values = [f.proof[place] for f in facts if f.is_converted]
        known = [value for value in values if value is not None]
        if known:
            found[name] = (median(known), max(known))
    return found


def in_unit(quantity: str, value: Any) -> float | None:
    """Convert m or rad to the unit in which ``SHOWN`` has it; None stays None."""
    return None if value is None else float(value) * SHOWN[quantity][2]
