"""The ledger: one line an attempt, append-only, and the rollouts that passed."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any, Literal

import mujoco

from flashdex.errors import FlashdexError, RunError, is_of_machine
from flashdex.metrics.criteria import (
    criterion_names,
    moves_too_little,
    stays_behind,
)
from flashdex.metrics.criteria_table import limits_of
from flashdex.metrics.tally import (
    UNMOVED,
    Tally,
    is_nearer,
    is_unmoved,
)
from flashdex.rollouts.certificate import PROVEN, Certificate, certify
from flashdex.rollouts.checks import RolloutCheck
from flashdex.rollouts.rollout import MAX_FILE, OF_SEARCH, Rollout, is_search_part
from flashdex.system.arrays import hash_content
from flashdex.system.files import own_file, own_folder, remove_own
from flashdex.system.jsonl import append_line, check_keys, drop_cut_line, read_lines
from flashdex.system.names import check_name, check_names, file_stem
from flashdex.system.run_files import (
    CONVERSIONS,
    MISSES,
    ROLLOUTS,
    miss_name,
    rollout_name,
)

Source = Literal["policy", "search"]
_LOG = logging.getLogger(__name__)
# what a line holds
LINE: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("motion", "criterion", "engine", "source"), str),
    **dict.fromkeys(("converted", "completed"), bool),
    **dict.fromkeys(("env_steps", "frame", "seed"), int),
    **dict.fromkeys(("wall_s", "gpu_s"), float),
    **dict.fromkeys(("passed", "hands", "why", "trivial"), list),
    **dict.fromkeys(("lift_ratio", "path_ratio"), (float, type(None))),
    "certified": (bool, type(None)),
    "errors": dict,
}
# and those that store a rollout, besides
OF_FILES = (
    *("rollout", "verdict", "rollout_sha256", "certificate_sha256"),
    *("miss", "miss_sha256"),  # of the nearest one so far
    "start",  # SHA-256 of the file that a search began at
)
STORED = {
    **dict.fromkeys(OF_FILES, (str, type(None))),
    "survived": (float, type(None)),  # share of perturbed replays
}
# of a search: of its ladder; core-seconds of the attempt, and of the run so far
SEARCHED = {"rung": int, "attempt_s": float, "core_s": float}


def read_ledger(path: Path) -> list[dict[str, Any]]:
    """The lines of ``conversions.jsonl``.

    Raises:
        RunError: one is no line of a ledger, or was changed; it is named.
    """
    lines = read_lines(path, {})
    for number, line in enumerate(lines, start=1):
        check_line(line, path, number)
    return lines


def check_line(line: dict[str, Any], path: Path, number: int) -> None:
    """Check that a line of a file is one of a ledger.

    Raises:
        RunError: it is not.
    """
    check_keys(line, LINE, path, number)
    check_name(line["motion"], what="motion", where=f"{path}: line {number}")
    more = {key: kind for key, kind in STORED.items() if key in line}
    searched = SEARCHED if line["source"] == "search" else {}
    check_keys(line, {**more, **searched}, path, number)
    errors = line["errors"]  # of a state that diverged they are not finite
    odd = {key: float for key, x in errors.items() if not isinstance(x, float)}
    check_keys(errors, odd, path, number)


def certificate_name(motion: str) -> str:
    """Where a run keeps the certificate of a motion."""
    return f"{ROLLOUTS}/{file_stem(motion)}.certificate.json"


class Ledger(Tally):
    """Scores attempts, writes a line for each, stores the first that passes.

    Until a motion has one, its nearest miss is stored. A stored rollout is on disk,
    complete, before its line is written: a crash can lose a line, never a conversion
    that has a line. ``adopt`` writes the line that is lost.

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
        lines = read_ledger(self.path)  # of earlier sessions
        super().__init__(names, criterion, lines)
        self.newest: dict[str, Any] = lines[-1] if lines else {}
        for name, line in list(self.misses.items()):
            if not self._has_miss(name, line):  # whose file is not the one it names
                del self.misses[name]

    def record(
        self,
        rollout: Rollout,
        *,
        wall_s: float,
        is_own: bool = True,
        certificate: Certificate | None = None,
    ) -> tuple[dict[str, Any], bool]:
        """Score one attempt, write its line and count it.

        Args:
            rollout: of the attempt.
            wall_s: seconds of the run so far.
            is_own: it was made here; else it was found in its file, which wants a line,
                and its model is tried in a child process first.
            certificate: of the rollout, where it has been made already; where more
                perturbed replays pass, it replaces the one before.

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
            **self._spent(rollout),
            "trivial": self._trivial(rollout),
        }
        # one that stands there is wanted: what it has replaced is gone
        is_wanted = not is_own or self._is_wanted(line, certificate)
        if line["converted"] and is_wanted:
            rollout.errors = json.dumps(line["errors"])
            if certificate is None and self.certify:
                xml = rollout.model_xml
                model = mujoco.MjModel.from_xml_string(xml) if is_own else None
                certificate = prove(rollout, model)
            line.update(self._store(rollout, certificate))
        elif not (self.is_done(name) or line["converted"]) and is_nearer(
            line, self.misses.get(name)
        ):
            line.update(self._keep(rollout, line))
        append_line(self.path, line)
        self.newest = line
        is_done = self.count(line)
        if is_done:
            remove_own(self.run_dir, miss_name(name))
        return line, is_done

    def _is_wanted(self, line: dict[str, Any], certificate: Certificate | None) -> bool:
        """Whether a pass is stored: the first one, or one that proves or moves more.

        One lucky draw is not the last word: later passes may still be proven, but not
        by one in which the object moves less.
        """
        before = self.conversions.get(line["motion"])
        if before is None or self.moves_more(line, before):
            return True
        if not self.certify or self.moves_more(before, line):
            return False
        return not before["certified"] or _is_better(certificate, before)

    def _spent(self, rollout: Rollout) -> dict[str, Any]:
        """What an attempt of a search says that it cost, and the run with it.

        Raises:
            RunError: it does not say so.
        """
        if self.source != "search":
            return {}
        said = json.loads(rollout.provenance).get(OF_SEARCH)
        if not is_search_part(said):
            raise RunError(f"{rollout.motion}: does not say what its search cost.")
        core_s = self.newest.get("core_s", 0.0) + said["attempt_s"]
        return {**said, "core_s": round(core_s, 3)}

    def _has_miss(self, name: str, line: dict[str, Any]) -> bool:
        path = own_file(self.run_dir, miss_name(name))
        known = line["miss_sha256"]
        return path.is_file() and hash_content(path, most=MAX_FILE) == known

    def _keep(self, rollout: Rollout, line: dict[str, Any]) -> dict[str, Any]:
        """Store the nearest miss of a motion so far; what its line says of the file."""
        rollout.errors = json.dumps(line["errors"])
        named = miss_name(rollout.motion)
        path = own_file(self.run_dir, named)
        own_folder(self.run_dir, MISSES)
        rollout.save(path)
        return {"miss": named, "miss_sha256": hash_content(path)}

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
            "survived": certificate.survived,
        }

    def adopt(self, *, wall_s: float) -> list[str]:
        """Write the lines of stored rollouts that a crash left without one.

        Each is scored anew from its file alone. One that does not pass, or that is
        damaged, stays where it is, without a line; a later conversion replaces it. The
        same with nearest misses; one whose motion has converted since is removed.
        Returns the motions told of.
        """
        out = []
        lines = read_ledger(self.path)
        for key, path_of in {"rollout": rollout_name, "miss": miss_name}.items():
            told = {x["motion"]: x for x in lines if x.get(key)}
            for name in self.names:
                path = own_file(self.run_dir, path_of(name))
                if not path.is_file():
                    continue
                if key == "miss" and self.is_done(name):
                    remove_own(self.run_dir, path_of(name))
                elif self._adopt(name, path, told.get(name), wall_s, key):
                    out.append(name)
        return out

    def _adopt(
        self,
        name: str,
        path: Path,
        line: dict[str, Any] | None,
        wall_s: float,
        key: str,
    ) -> bool:
        """Write the line of one stored rollout or miss, unless it has one."""
        if line is not None and line.get(f"{key}_sha256") == hash_content(
            path, most=MAX_FILE
        ):
            return False
        try:
            rollout = Rollout.load(path)
            if rollout.motion != name:
                raise RunError(f"{path}: is the rollout of '{rollout.motion}'.")
            # A later pass replaces the file of an unproven one: compare when it was.
            if line is not None and line["env_steps"] == rollout.env_steps:
                raise RunError(f"{path}: was changed after its line was written.")
            is_miss = key == "miss"
            if rollout.score()[self.criterion].is_passed == is_miss:
                return False
            check = RolloutCheck(rollout, path.name, None, is_miss=is_miss)
            for finding in check.run():
                if finding.is_fault:
                    raise RunError(f"{finding}.")
            self.record(rollout, wall_s=wall_s, is_own=False)
        except FlashdexError as error:
            if is_of_machine(error):
                raise
            _LOG.warning("%s It is left as it is; 'flashdex verify' tells more", error)
            return False
        return True

    @property
    def num_bytes(self) -> int:
        """Length of the file."""
        return self.path.stat().st_size if self.path.is_file() else 0


COUNTERS = ("env_steps", "frame", "seed", "wall_s")
ROUNDED = 1e-6  # m or rad, of the values in a line


def prove(rollout: Rollout, model: mujoco.MjModel | None) -> Certificate | None:
    """The certificate of a rollout; None, and a word in the log, where it has none.

    ``model`` is that of the rollout where somebody made it here, see ``certify``.
    """
    try:
        return certify(rollout, model=model)
    except (FlashdexError, ValueError) as error:
        if is_of_machine(error):
            raise
        _LOG.warning("%s: not certified: %s", rollout.motion, error)
        return None


def _is_better(certificate: Certificate | None, before: dict[str, Any]) -> bool:
    """A proof in which more perturbed replays pass than by a line."""
    return (
        certificate is not None
        and certificate.verdict in PROVEN
        and certificate.survived > (before.get("survived") or 0.0)
    )


def line_faults(line: dict[str, Any], of_run: dict[str, Any]) -> list[str]:
    """What a line says against itself or its run, of which all lines say ``of_run``."""
    found = [
        f"{key} is {line[key]!a:.60}, of the run {value!a:.60}"
        for key, value in of_run.items()
        if line[key] != value
    ]
    found += [f"{key} is {line[key]}" for key in COUNTERS if line[key] < 0]
    named, known = [line["criterion"], *line["passed"]], criterion_names()
    if odd := [name for name in named if name not in known]:
        return [*found, f"names {odd[0]!a:.60}, which is no criterion"]
    ratios = {key: line[f"{key}_ratio"] for key in ("lift", "path")}
    passes = line["criterion"] in line["passed"]
    if passes and not _is_within(line["errors"], line["criterion"]):
        found.append("errors are not those of a pass")
    if passes and moves_too_little(ratios) and not is_unmoved(line):
        found.append(f"lacks '{UNMOVED}' in trivial, by its ratios")
    return found


def _is_within(errors: dict[str, float], criterion: str) -> bool:
    """Whether these are the values of a criterion, and those with a most are below."""
    limits = {k: v for k, v in limits_of(criterion, 0).items() if k != "grace"}
    return errors.keys() == limits.keys() and all(
        value <= limits[name] + ROUNDED
        for name, value in errors.items()
        if name not in ("lift", "path")
    )
