"""The ledger: one line an attempt, append-only, and the rollouts that passed."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import RunError
from flashdex.rollouts.certificate import PROVEN, certify
from flashdex.rollouts.rollout import Rollout
from flashdex.system.jsonl import append_line, drop_cut_line, read_lines

_LOG = logging.getLogger(__name__)
CONVERSIONS = "conversions.jsonl"
ROLLOUTS = "rollouts"


class Ledger:
    """Scores attempts, writes a line for each, stores the first that passes.

    A stored rollout is on disk, complete, before its line is written: a crash can lose
    a line, never a conversion that has a line. ``adopt`` writes the line that is lost.

    Seconds count as a GPU's where one steps the physics (``on_gpu``). Conversions get a
    certificate if ``certify``. ``trivial``: baselines that already pass a motion.
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
        # motion -> line of its first pass, with the newest verdict
        self.conversions: dict[str, dict[str, Any]] = {}
        self.last: dict[str, bool] = {}  # motion -> whether its newest attempt passed
        self.attempts: dict[str, int] = dict.fromkeys(names, 0)  # motion -> lines
        drop_cut_line(self.path)
        for line in read_lines(self.path):  # of earlier sessions
            # A resume may ask for another criterion, or for fewer motions.
            if line["criterion"] == criterion and line["motion"] in names:
                self.count(line)

    def record(self, rollout: Rollout, *, wall_s: float) -> tuple[dict[str, Any], bool]:
        """Score one attempt, write its line and count it.

        Returns:
            The line, and whether this attempt is the motion's first that passes.
        """
        name = rollout.motion
        line = {
            **rollout.summary(self.criterion),
            "wall_s": round(wall_s, 3),
            "gpu_s": round(wall_s, 3) if self.on_gpu else 0.0,
            "seed": self.seed,
            "engine": self.engine,
            "trivial": self.trivial.get(name, []),
        }
        before = self.conversions.get(name)
        # One lucky draw is not the last word: later passes may still be proven.
        unproven = before is None or (self.certify and not before["certified"])
        if line["converted"] and unproven:
            line.update(self._store(rollout, line["errors"]))
        append_line(self.path, line)
        return line, self.count(line)

    def count(self, line: dict[str, Any]) -> bool:
        """Count a line that is in the file; is it the motion's first that passes?"""
        name = line["motion"]
        self.attempts[name] = self.attempts.get(name, 0) + 1
        self.last[name] = line["converted"]
        is_first = line["converted"] and name not in self.conversions
        if is_first:
            self.conversions[name] = dict(line)
        if line.get("verdict") is not None:
            newest = {key: line[key] for key in ("certified", "verdict")}
            self.conversions[name].update(newest)
        return is_first

    def _store(self, rollout: Rollout, errors: dict[str, float]) -> dict[str, Any]:
        """Store a rollout that passed; what its line says of the file."""
        rollout.errors = json.dumps(errors)
        path = self.rollouts / f"{rollout.motion}.npz"
        rollout.save(path)
        out: dict[str, Any] = {"rollout": f"{ROLLOUTS}/{path.name}"}
        if not self.certify:
            return out
        try:
            certificate = certify(rollout)
        except RunError as error:
            _LOG.warning("%s: not certified: %s", rollout.motion, error)
            return {**out, "certified": False, "verdict": "not_measured"}
        certificate.save(path.with_suffix(".certificate.json"))
        verdict = certificate.verdict
        return {**out, "certified": verdict in PROVEN, "verdict": verdict}

    def adopt(self, *, wall_s: float) -> list[str]:
        """Write the lines of stored rollouts that a crash left without one.

        Each is scored anew from its file alone. One that does not pass stays where it
        is, without a line; a later conversion replaces it. Returns the motions told of.
        """
        lines = read_lines(self.path)
        told = {x["rollout"]: x["env_steps"] for x in lines if x.get("rollout")}
        out = []
        for name in self.names:
            path = self.rollouts / f"{name}.npz"
            if not path.is_file():
                continue
            with np.load(path, allow_pickle=False) as file:
                made_at = int(file["env_steps"])
            # A later pass replaces the file of an unproven one: compare when it was.
            if told.get(f"{ROLLOUTS}/{path.name}") == made_at:
                continue
            rollout = Rollout.load(path)
            if rollout.score()[self.criterion].is_passed:
                self.record(rollout, wall_s=wall_s)
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
        return sum(bool(c["certified"]) for c in self.conversions.values())

    def metrics(self, hours: float) -> dict[str, float]:
        """Counters of the ``convert/`` group after so many hours of wall time."""
        total = len(self.names)
        passing = sum(self.last.get(n, False) for n in self.names)
        robust = sum(c.get("verdict") == "robust" for c in self.conversions.values())
        out = {
            "convert/cumulative": float(self.num_converted),
            "convert/rate": self.num_converted / total,
            "convert/last": passing / total,
            "convert/certified": float(self.num_certified),
            "convert/robust": float(robust),
            "convert/attempts": float(self.num_attempts),
        }
        if hours > 0:
            out["convert/per_hour"] = self.num_converted / hours
        return out
