"""The ledger: one line an attempt, append-only, and the rollouts that passed."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any, Literal

import mujoco

from flashdex.errors import FlashdexError, RunError
from flashdex.metrics.criteria import moves_too_little, stays_behind
from flashdex.metrics.tally import UNMOVED, Tally, is_unmoved
from flashdex.rollouts.certificate import PROVEN, Certificate, certify
from flashdex.rollouts.checks import RolloutCheck
from flashdex.rollouts.rollout import Rollout
from flashdex.system.arrays import hash_content
from flashdex.system.files import own_file, own_folder, remove_own
from flashdex.system.jsonl import append_line, drop_cut_line, read_lines
from flashdex.system.names import check_name, check_names, file_stem
from flashdex.system.run_files import CONVERSIONS, ROLLOUTS, rollout_name

Source = Literal["policy", "search"]
_LOG = logging.getLogger(__name__)
# what a line holds, of any version
LINE: dict[str, type | tuple[type, ...]] = {
    "motion": str,
    "converted": bool,
    "criterion": str,
    "errors": dict,
    "env_steps": int,
    "wall_s": float,
}
# what newer versions, or only some lines, hold besides
_MORE: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("passed", "hands", "why", "trivial"), (list,)),
    **dict.fromkeys(("frame", "seed", "rung"), (int,)),
    **dict.fromkeys(("rollout", "verdict"), (str, type(None))),
    **dict.fromkeys(("rollout_sha256", "certificate_sha256"), (str, type(None))),
    **dict.fromkeys(("lift_ratio", "path_ratio"), (float, int, type(None))),
    "certified": (bool, type(None)),
    "completed": (bool,),
    **dict.fromkeys(("gpu_s", "core_s", "attempt_s"), (float, int)),
    **dict.fromkeys(("engine", "source"), (str,)),
}


def read_ledger(path: Path) -> list[dict[str, Any]]:
    """The lines of ``conversions.jsonl``.

    Raises:
        RunError: one is no line of a ledger, or was changed; it is named.
    """
    lines = read_lines(path, LINE)
    for number, line in enumerate(lines, start=1):
        where = f"{path}: line {number}"
        check_name(line["motion"], what="motion", where=where)
        if not math.isfinite(line["wall_s"]):
            raise RunError(f"{where} has {line['wall_s']} as 'wall_s'.")
        for key, kinds in _MORE.items():
            value = line.get(key)
            if key in line and type(value) not in kinds:
                raise RunError(
                    f"{where} has {value!r:.60} as '{key}'. flashdex only adds lines "
                    "to this file; restore it from a copy."
                )
    return lines


def certificate_name(motion: str) -> str:
    """Where a run keeps the certificate of a motion."""
    return f"{ROLLOUTS}/{file_stem(motion)}.certificate.json"


class Ledger(Tally):
    """Scores attempts, writes a line for each, stores the first that passes.

    A stored rollout is on disk, complete, before its line is written: a crash can lose
    a line, never a conversion that has a line. ``adopt`` writes the line that is lost.

    Seconds count as a GPU's where one steps the physics (``on_gpu``). Conversions get a
    certificate if ``certify``. ``trivial``: baselines that already pass a motion.
    ``source`` is who finds the attempts.
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
        source: Source = "policy",
    ) -> None:
        check_names(names, what="motion")
        run_dir.mkdir(parents=True, exist_ok=True)
        self.run_dir, self.path = run_dir, own_file(run_dir, CONVERSIONS)
        self.rollouts = own_folder(run_dir, ROLLOUTS)
        self.seed, self.engine, self.on_gpu = seed, engine, on_gpu
        self.source = source
        self.certify, self.trivial = certify, trivial or {}
        drop_cut_line(self.path)
        super().__init__(names, criterion, read_ledger(self.path))  # earlier sessions

    def record(
        self,
        rollout: Rollout,
        *,
        wall_s: float,
        is_own: bool = True,
        certificate: Certificate | None = None,
        more: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], bool]:
        """Score one attempt, write its line and count it.

        Args:
            rollout: of the attempt.
            wall_s: seconds of the run so far.
            is_own: it was made here; a model that was found in a file is tried in a
                child process first.
            certificate: of the rollout, where it has been made already; one that is
                robust may replace what is only certified.
            more: entries of the line that its source adds.

        Returns:
            The line, and whether the motion is done by this attempt.
        """
        name = rollout.motion
        summary = rollout.summary(self.criterion)
        line = {
            **summary,
            "wall_s": round(wall_s, 3),
            "gpu_s": round(wall_s, 3) if self.on_gpu else 0.0,
            "seed": self.seed,
            "engine": self.engine,
            "source": self.source,
            **(more or {}),
            "trivial": self._trivial(rollout),
        }
        before = self.conversions.get(name)
        # One lucky draw is not the last word: later passes may still be proven, but not
        # by one in which the object moves less.
        is_wanted = (
            before is None
            or self.moves_more(line, before)
            or (
                self.certify
                and not self.moves_more(before, line)
                and (not before["certified"] or _is_better(certificate, before))
            )
        )
        if line["converted"] and is_wanted:
            rollout.errors = json.dumps(line["errors"])
            if certificate is None and self.certify:
                certificate = _prove(rollout, is_own=is_own)
            line.update(self._store(rollout, certificate))
        append_line(self.path, line)
        return line, self.count(line)

    def _trivial(self, rollout: Rollout) -> list[str]:
        """Baselines that pass the motion, and whether this attempt moved too little."""
        unmoved = [UNMOVED] if stays_behind(rollout.tracking_errors()) else []
        return [*self.trivial.get(rollout.motion, []), *unmoved]

    def _store(
        self, rollout: Rollout, certificate: Certificate | None
    ) -> dict[str, Any]:
        """Store a rollout that passed; what its line says of the files."""
        named = rollout_name(rollout.motion)
        path = own_file(self.run_dir, named)
        proof = own_file(self.run_dir, certificate_name(rollout.motion))
        # A crash may leave a rollout without certificate, never with that of another.
        remove_own(self.run_dir, certificate_name(rollout.motion))
        own_folder(self.run_dir, ROLLOUTS)  # below the run, if that is still there
        rollout.save(path)
        out: dict[str, Any] = {"rollout": named, "rollout_sha256": hash_content(path)}
        if not self.certify:
            return out
        if certificate is None:
            return {**out, "certified": False, "verdict": "not_measured"}
        certificate.save(proof)
        verdict = certificate.verdict
        return {
            **out,
            "certificate_sha256": hash_content(proof),
            "certified": verdict in PROVEN,
            "verdict": verdict,
        }

    def adopt(self, *, wall_s: float) -> list[str]:
        """Write the lines of stored rollouts that a crash left without one.

        Each is scored anew from its file alone. One that does not pass, or that is
        damaged, stays where it is, without a line; a later conversion replaces it.
        Returns the motions told of.
        """
        told = {x["motion"]: x for x in read_ledger(self.path) if x.get("rollout")}
        out = []
        for name in self.names:
            path = own_file(self.run_dir, rollout_name(name))
            if path.is_file() and self._adopt(name, path, told.get(name), wall_s):
                out.append(name)
        return out

    def _adopt(
        self, name: str, path: Path, line: dict[str, Any] | None, wall_s: float
    ) -> bool:
        """Write the line of one stored rollout, unless it has one."""
        if line is not None and line.get("rollout_sha256") == hash_content(path):
            return False
        try:
            rollout = Rollout.load(path)
            if rollout.motion != name:
                raise RunError(f"{path}: is the rollout of '{rollout.motion}'.")
            # A later pass replaces the file of an unproven one: compare when it was.
            if line is not None and line["env_steps"] == rollout.env_steps:
                if "rollout_sha256" in line:
                    raise RunError(f"{path}: was changed after its line was written.")
                return False
            if not rollout.score()[self.criterion].is_passed:
                return False
            for finding in RolloutCheck(rollout, path.name, None).run():
                if finding.is_fault:
                    raise RunError(f"{finding}.")
        except FlashdexError as error:
            _LOG.warning("%s It is left as it is; 'flashdex verify' tells more", error)
            return False
        self.record(rollout, wall_s=wall_s, is_own=False)
        return True

    @property
    def num_bytes(self) -> int:
        """Length of the file."""
        return self.path.stat().st_size if self.path.is_file() else 0


def _prove(rollout: Rollout, *, is_own: bool) -> Certificate | None:
    try:
        xml = rollout.model_xml
        model = mujoco.MjModel.from_xml_string(xml) if is_own else None
        return certify(rollout, model=model)
    except (FlashdexError, ValueError) as error:
        _LOG.warning("%s: not certified: %s", rollout.motion, error)
        return None


def _is_better(certificate: Certificate | None, before: dict[str, Any]) -> bool:
    """A proof of robustness, against a line whose rollout has none."""
    is_robust = certificate is not None and certificate.verdict == "robust"
    return is_robust and before.get("verdict") != "robust"


# what every line holds since runs have an id, and of which one run has one value
NEWER = ("passed", "trivial", "lift_ratio", "path_ratio", "seed", "engine")
OF_RUN = ("seed", "engine", "criterion")
SPEED = "convert/per_hour"  # of a clock that went on between two readings
SPEED_TOLERANCE = 0.05


def line_faults(line: dict[str, Any], of_run: dict[str, Any]) -> list[str]:
    """What a line of a run with an id lacks, or says against itself or its run."""
    found = [f"lacks {key!a}" for key in NEWER if key not in line]
    found += [
        f"{key} is {line[key]!a:.60}, of the run {of_run[key]!a:.60}"
        for key in OF_RUN
        if key in line and key in of_run and line[key] != of_run[key]
    ]
    ratios = {key: line.get(f"{key}_ratio") for key in ("lift", "path")}
    passes = line["criterion"] in line.get("passed", [])
    if passes and moves_too_little(ratios) and not is_unmoved(line):
        found.append(f"lacks '{UNMOVED}' in trivial, by its ratios")
    return found


def count_faults(
    records: list[dict[str, Any]], lines: list[dict[str, Any]], tally: Tally
) -> list[str]:
    """The first record of the metrics that does not count the lines there were."""
    counted = 0
    for number, record in enumerate(records, start=1):
        attempts = record.get("convert/attempts", -1)
        if not counted <= attempts <= len(lines):
            return [f"record {number}: convert/attempts is {attempts:g}"]
        for line in lines[counted : int(attempts)]:
            tally.count(line)
        counted = int(attempts)
        for key, value in tally.metrics(record["hours"]).items():
            slack = SPEED_TOLERANCE if key == SPEED else 0.0
            said = record.get(key, math.nan)
            if not abs(said - value) <= slack * value + 1e-9:
                text = f"record {number}: {key} is {said:g}, by the lines {value:g}"
                return [text]
    return []
