"""The ledger: one line an attempt, append-only, and the rollouts that passed."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex import keys
from flashdex.errors import RunError
from flashdex.metrics.criteria import score
from flashdex.rollouts.build import Attempt
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.rollout import Rollout
from flashdex.system.jsonl import append_line, drop_cut_line, read_lines

_LOG = logging.getLogger(__name__)
CONVERSIONS = "conversions.jsonl"
ROLLOUTS = "rollouts"


@dataclass
class Conversion:
    """A motion's first passing attempt.

    Attributes:
        motion: name.
        env_steps: counter when it passed.
        wall_s: seconds since the run began.
        certified: whether its certificate holds, None when none was asked for.
        verdict: verdict of the certificate.
    """

    motion: str
    env_steps: int
    wall_s: float
    certified: bool | None
    verdict: str | None = None


class Ledger:
    """Judges attempts, writes a line for each, stores the first that passes.

    A stored rollout is on disk, complete, before its line is written: a crash can lose
    a line, never a conversion that has a line. ``adopt`` writes the line that is lost.

    Args:
        run_dir: run directory.
        names: motions of the collection.
        criterion: what counts as a conversion.
        seed: of the run.
        engine: physics engine of the rollouts.
        on_gpu: a GPU steps the physics, so that its seconds count.
        certify: replay conversions and write the certificate.
        trivial: motions that a baseline already passes.
    """

    def __init__(
        self,
        run_dir: Path,
        names: list[str],
        *,
        criterion: str,
        seed: int,
        engine: str,
        on_gpu: bool = False,
        certify: bool = True,
        trivial: dict[str, list[str]] | None = None,
    ) -> None:
        self.path = run_dir / CONVERSIONS
        self.rollouts = run_dir / ROLLOUTS
        self.rollouts.mkdir(parents=True, exist_ok=True)
        self.names, self.criterion, self.seed = names, criterion, seed
        self.engine, self.on_gpu = engine, on_gpu
        self.certify, self.trivial = certify, trivial or {}
        self.conversions: dict[str, Conversion] = {}
        self.last: dict[str, bool] = {}
        self.attempts: dict[str, int] = dict.fromkeys(names, 0)
        self.last_line: dict[str, Any] = {}
        self._read()

    def _read(self) -> None:
        """Take up the lines of an earlier session of the same run."""
        drop_cut_line(self.path)
        for line in read_lines(self.path):
            # A resume may ask for another criterion, or for fewer motions.
            same = line["criterion"] == self.criterion
            if same and line["motion"] in self.names:
                self._count(line)

    def _count(self, line: dict[str, Any]) -> None:
        name = line["motion"]
        self.attempts[name] = self.attempts.get(name, 0) + 1
        self.last[name] = line["converted"]
        if line["converted"] and name not in self.conversions:
            self.conversions[name] = Conversion(
                name, line["env_steps"], line["wall_s"], line["certified"]
            )
        if line.get("verdict") is not None:
            self.conversions[name].certified = line["certified"]
            self.conversions[name].verdict = line["verdict"]

    def record(
        self, attempt: Attempt, *, env_steps: int, wall_s: float
    ) -> Conversion | None:
        """Judge one attempt and write its line.

        Args:
            attempt: finished episode.
            env_steps: counter of the run.
            wall_s: seconds since the run began, earlier sessions included.

        Returns:
            The conversion, if this attempt is the motion's first that passes.
        """
        rollout = attempt.rollout
        verdicts = score(
            rollout.signals(), grace=rollout.grace, completed=attempt.completed
        )
        verdict = verdicts[self.criterion]
        converted = verdict.is_passed
        name = rollout.motion
        first = converted and name not in self.conversions
        # One lucky draw is not the last word: later passes may still be proven.
        unproven = self.certify and not first and converted
        unproven = unproven and not self.conversions[name].certified
        line: dict[str, Any] = {
            "motion": name,
            "converted": converted,
            "certified": None,
            "criterion": self.criterion,
            "errors": {k: round(v, 6) for k, v in verdict.values.items()},
            "passed": [k for k, v in verdicts.items() if v.is_passed],
            "completed": attempt.completed,
            "hands": [
                side
                for side, on in zip(keys.SIDES, rollout.hand_active, strict=True)
                if on
            ],
            "why": _why(attempt, verdict.reason, verdict.blame),
            "frame": attempt.frame,
            "env_steps": env_steps,
            "wall_s": round(wall_s, 3),
            "gpu_s": round(wall_s, 3) if self.on_gpu else 0.0,
            "seed": self.seed,
            "engine": self.engine,
            "trivial": self.trivial.get(name, []),
        }
        if first or unproven:
            line.update(self._store(attempt, line))
        append_line(self.path, line)
        self.last_line = line
        return self.take(line)

    def take(self, line: dict[str, Any]) -> Conversion | None:
        """Count a line that is in the file, written here or by another process.

        Args:
            line: of one attempt.

        Returns:
            The conversion, if it is the motion's first.
        """
        known = line["motion"] in self.conversions
        self._count(line)
        return None if known else self.conversions.get(line["motion"])

    def _store(self, attempt: Attempt, line: dict[str, Any]) -> dict[str, Any]:
        rollout = attempt.rollout
        rollout.errors = json.dumps(line["errors"])
        path = self.rollouts / f"{rollout.motion}.npz"
        rollout.save(path)
        out: dict[str, Any] = {"rollout": f"{ROLLOUTS}/{path.name}"}
        if self.certify:
            try:
                certificate = certify(rollout)
            except RunError as error:
                _LOG.warning("%s: not certified: %s", rollout.motion, error)
                return {**out, "certified": False, "verdict": "not_measured"}
            certificate.save(path.with_suffix(".certificate.json"))
            out["certified"] = certificate.verdict in ("certified", "robust")
            out["verdict"] = certificate.verdict
        return out

    def adopt(self, *, wall_s: float) -> list[str]:
        """Write the lines of stored rollouts that a crash left without one.

        Each is judged anew from its file alone. One that does not pass stays where it
        is, without a line; a later conversion replaces it.

        Args:
            wall_s: clock of the run, for the lines.

        Returns:
            Motions whose lines were written.
        """
        told = {
            line["rollout"]: line["env_steps"]
            for line in read_lines(self.path)
            if line.get("rollout")
        }
        out = []
        for row, name in enumerate(self.names):
            path = self.rollouts / f"{name}.npz"
            if not path.is_file():
                continue
            # A later pass replaces the file of an unproven one: compare when it was.
            if told.get(f"{ROLLOUTS}/{path.name}") == _env_steps(path):
                continue
            attempt = _stored_attempt(path, row)
            verdicts = score(attempt.rollout.signals(), grace=attempt.rollout.grace)
            if verdicts[self.criterion].is_passed:
                steps = attempt.rollout.env_steps
                self.record(attempt, env_steps=steps, wall_s=wall_s)
                out.append(name)
        return out

    @property
    def num_bytes(self) -> int:
        """Length of the file."""
        return self.path.stat().st_size if self.path.is_file() else 0

    @property
    def note(self) -> str:
        """What was achieved, in a few words."""
        text = f"{self.num_converted}/{len(self.names)} converted"
        return f"{text}, {self.num_certified} certified" if self.conversions else text

    @property
    def num_attempts(self) -> int:
        """Attempts of all motions."""
        return sum(self.attempts.values())

    @property
    def num_converted(self) -> int:
        """Motions with at least one passing attempt."""
        return len(self.conversions)

    @property
    def num_certified(self) -> int:
        """Converted motions whose certificate holds."""
        return sum(bool(c.certified) for c in self.conversions.values())

    @property
    def num_robust(self) -> int:
        """Converted motions whose certificate holds under disturbances too."""
        return sum(c.verdict == "robust" for c in self.conversions.values())

    def metrics(self, hours: float) -> dict[str, float]:
        """Counters of the ``convert/`` group after so many hours of wall time."""
        total = len(self.names)
        passing = sum(self.last.get(n, False) for n in self.names)
        out = {
            "convert/cumulative": float(self.num_converted),
            "convert/rate": self.num_converted / total,
            "convert/last": passing / total,
            "convert/certified": float(self.num_certified),
            "convert/robust": float(self.num_robust),
            "convert/attempts": float(self.num_attempts),
        }
        if hours > 0:
            out["convert/per_hour"] = self.num_converted / hours
        return out


def _env_steps(path: Path) -> int:
    """When a stored rollout was made; reads nothing else of the file."""
    with np.load(path, allow_pickle=False) as file:
        return int(file["env_steps"])


def _stored_attempt(path: Path, row: int) -> Attempt:
    """A stored rollout as the attempt it was."""
    rollout = Rollout.load(path)
    complete = rollout.num_frames >= rollout.reference_length
    return Attempt(rollout, row, complete, [], rollout.num_frames)


def _why(attempt: Attempt, reason: str, blame: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Causes of a failed attempt: what ended it, or which limit which hand crossed."""
    if attempt.why:
        return [dict(w) for w in attempt.why]
    if blame:
        return [
            {
                "cause": b.term,
                "hand": b.side,
                "value": round(b.value, 5),
                "frame": b.frame,
            }
            for b in blame
        ]
    return [{"cause": reason}] if reason else []
