"""``flashdex replay`` and ``verify``: a run's claims against what can be recomputed.

Files are bound to one another by hashes: a rollout names recipe, library and reference,
a certificate its rollout, a line of the ledger both files, each line the one before.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flashdex.errors import FlashdexError, RunError, is_of_machine
from flashdex.metrics.criteria import criterion_names, stays_behind
from flashdex.metrics.tally import UNMOVED, follow_misses
from flashdex.recipe import Recipe
from flashdex.rollouts.certificate import PROVEN, certify, compare_certificates
from flashdex.rollouts.checks import RolloutCheck
from flashdex.rollouts.claims import Era, RunClaims
from flashdex.rollouts.findings import Finding, at, differences, faults
from flashdex.rollouts.rollout import MAX_FILE, OF_SEARCH, Rollout
from flashdex.rollouts.truth import Truth
from flashdex.system.arrays import hash_content
from flashdex.system.files import own_files
from flashdex.system.jsonl import read_object
from flashdex.system.names import file_stem
from flashdex.system.run_files import (
    CONVERSIONS,
    MISSES,
    MOTIONS,
    RECIPE,
    ROLLOUTS,
    SESSIONS,
    VERSIONS,
    check_run,
    miss_name,
    rollout_name,
)

CERTIFICATE = ".certificate.json"
# of a line: what is computed from the rollout it names
COUNTED = ("motion", "converted", "criterion", "errors", "hands", "frame", "env_steps")
COUNTED += ("lift_ratio", "path_ratio")


@dataclass(frozen=True)
class Replayed:
    """One stored rollout: what the run says of it, and what was found."""

    motion: str
    stored: str | None  # verdict in the run's files, None when there is none
    found: str  # verdict of the certificate made now
    findings: tuple[Finding, ...]  # of rollout, certificate and its line

    @property
    def holds(self) -> bool:
        """The conversion is proven, and the files say so truthfully."""
        return not faults(self.findings) and self.found in PROVEN


@dataclass(frozen=True)
class Verified:
    """What was found in a run."""

    rollouts: list[Replayed]
    ledger: list[Finding]  # of the lines, and of files that no line names
    eras: list[Era]  # recipes of the run
    misses: dict[str, list[Finding]]  # file of a nearest miss -> what was found

    @property
    def findings(self) -> list[Finding]:
        """All, those of the ledger first."""
        of_files = [*(one.findings for one in self.rollouts), *self.misses.values()]
        return [finding for some in (self.ledger, *of_files) for finding in some]

    @property
    def holds(self) -> bool:
        """Every stored rollout is proven, and the lines are those of the run."""
        return not faults(self.findings) and all(one.holds for one in self.rollouts)


def verify_run(run_dir: str | Path, truth: Truth | None = None) -> Verified:
    """Recompute everything that the stored rollouts of a run claim.

    Args:
        run_dir: folder of the run.
        truth: its recipe with its library; without, what they would tell is listed as
            not checked.

    Raises:
        RunError: there is nothing to verify.
    """
    return _RunCheck(Path(run_dir), truth).run()


def verify_file(path: str | Path, truth: Truth | None = None) -> list[Finding]:
    """What is found in one rollout file, without the run around it.

    Raises:
        RunError: it is no rollout.
    """
    path = Path(path)
    check = RolloutCheck(Rollout.load(path), str(path), truth)
    return check.run()


class _RunCheck:
    def __init__(self, run_dir: Path, truth: Truth | None) -> None:
        self.run_dir, self.truth = run_dir, truth
        self.claims = RunClaims(run_dir)
        self._truths: dict[str, Truth | None] = {}  # by the hash of a recipe

    def run(self) -> Verified:
        check_run(self.run_dir)  # a link under the name of any file of a run
        files = own_files(self.run_dir, ROLLOUTS, "*.npz")
        lines = self.claims.lines(self.truth and self.truth.bank.names)
        told = {x["motion"]: x for x in lines if x.get("rollout")}  # the newest
        names = {file.name for file in files}
        for motion in told:
            if Path(rollout_name(motion)).name not in names:
                self.claims.fault(motion, f"its {rollout_name(motion)} is missing")
        for path in own_files(self.run_dir, ROLLOUTS, f"*{CERTIFICATE}"):
            if path.name.removesuffix(CERTIFICATE) + ".npz" not in names:
                self.claims.fault("certificate", "of no rollout", file=self._name(path))
        misses = self._misses(lines)
        if not (files or told or misses or faults(self.claims.findings)):
            raise RunError(
                f"{self.run_dir}: no stored rollout in '{ROLLOUTS}/'. Either nothing "
                "has been converted yet, or this is not a run directory."
            )
        found = [self._one(file, told) for file in files]
        return Verified(found, self.claims.findings, self.claims.eras, misses)

    def _misses(self, lines: list[dict[str, Any]]) -> dict[str, list[Finding]]:
        """Nearest misses by file; no conversion is counted among them."""
        told: dict[str, dict[str, Any]] = {}
        for line in lines:
            follow_misses(told, line)
        found = {
            path: self._miss(path, told)
            for path in own_files(self.run_dir, MISSES, "*.npz")
        }
        for motion in told:
            if self.run_dir / miss_name(motion) not in found:
                self.claims.fault(motion, f"its {miss_name(motion)} is missing")
        return {self._name(path): findings for path, findings in found.items()}

    def _miss(self, path: Path, told: dict[str, dict[str, Any]]) -> list[Finding]:
        file = self._name(path)
        try:
            rollout = Rollout.load(path)
        except FlashdexError as error:
            return [Finding(file, "file", str(error))]
        line = told.get(rollout.motion)
        check, found = self._checked(file, rollout, line, is_miss=True)
        if check.is_sound:
            found += self._told(line, path, rollout, {}, {"miss_sha256": path})
        return found

    def _name(self, path: Path) -> str:
        return path.relative_to(self.run_dir).as_posix()

    def _one(self, path: Path, told: dict[str, dict[str, Any]]) -> Replayed:
        file = self._name(path)
        try:
            rollout = Rollout.load(path)
        except FlashdexError as error:
            stem = path.stem
            line = next((x for m, x in told.items() if file_stem(m) == stem), {})
            fault = Finding(file, "file", str(error))
            return Replayed(stem, line.get("verdict"), "not_measured", (fault,))
        line = told.get(rollout.motion)
        check, found = self._checked(file, rollout, line)
        verdict, stored, compared = self._certificate(path, rollout, check)
        found += compared
        if check.is_sound:
            proof = path.with_name(path.stem + CERTIFICATE)
            files = {"rollout_sha256": path, "certificate_sha256": proof}
            found += self._told(line, path, rollout, stored, files)
        return Replayed(rollout.motion, stored.get("verdict"), verdict, tuple(found))

    def _checked(
        self,
        file: str,
        rollout: Rollout,
        line: dict[str, Any] | None,
        *,
        is_miss: bool = False,
    ) -> tuple[RolloutCheck, list[Finding]]:
        """The check of a rollout or miss, and what it and the run's files tell."""
        said = json.loads(rollout.provenance)
        recipe = said.get("recipe_sha256")
        truth, found = self._recipe(recipe, rollout.hand, file, line)
        found += self._bound(rollout, said, file, truth)
        check = RolloutCheck(rollout, file, truth, is_miss=is_miss)
        found += check.run()
        named = miss_name if is_miss else rollout_name
        if file != named(rollout.motion):
            found.append(Finding(file, "motion", f"is that of '{rollout.motion}'"))
        return check, found

    def _recipe(
        self, sha256: Any, hand: str, file: str, line: dict[str, Any] | None
    ) -> tuple[Truth | None, list[Finding]]:
        """Library and the recipe that a rollout was made by, which one of the run's."""
        era = self.claims.era_of(sha256)
        if era is None:
            text = f"is none of those that {RECIPE} and {SESSIONS} hold"
            return self.truth, [Finding(file, "recipe", text)]
        found = []
        if hand != era.plain.get("hand"):
            found.append(Finding(file, "hand", f"is another than that of {RECIPE}"))
        if line is not None and not era.holds(line["wall_s"]):
            found.append(Finding(file, "recipe", "is that of another time of the run"))
        now = self.truth
        if now is None or era is self.claims.eras[-1]:
            return now, found
        recipe = era.recipe
        if (
            not isinstance(recipe, Recipe)
            or recipe.hand != now.recipe.hand
            or recipe.motions != now.recipe.motions
        ):
            text = "of an earlier recipe, whose library is not at hand"
            return None, [*found, Finding(file, "library", text, is_fault=False)]
        if sha256 not in self._truths:
            self._truths[sha256] = replace(now, recipe=recipe)
        return self._truths[sha256], found

    def _bound(
        self, rollout: Rollout, said: dict[str, Any], file: str, truth: Truth | None
    ) -> list[Finding]:
        """Run, library and motion that the rollout was made by."""
        name = rollout.motion
        known: dict[tuple[str, str], Any] = {
            ("run", f"that of {VERSIONS}"): self.claims.run,
            ("motion_sha256", f"that of {MOTIONS}"): self.claims.motions.get(name),
        }
        if truth is not None:
            library, names = truth.library, truth.bank.names
            known["library_sha256", str(library.path)] = library.content_hash
            if name in names:
                sha = library.motion_hash(names.index(name))
                known["motion_sha256", "that of the library"] = sha
        found = [
            Finding(file, key, f"is another than {of}: it was made from another")
            for (key, of), right in known.items()
            if said.get(key) != right
        ]
        if not self.claims.is_of_session(said.get("date")):
            found.append(Finding(file, "date", "is of no session of the run"))
        made_by = json.loads(rollout.versions)
        return found + [
            Finding(file, "versions", f"{key} is not {right!a}, as {VERSIONS} says")
            for key, right in self.claims.made_by.items()
            if not str(made_by.get(key)).endswith(right)  # a GPU stands before it
        ]

    def _certificate(
        self, path: Path, rollout: Rollout, check: RolloutCheck
    ) -> tuple[str, dict[str, Any], list[Finding]]:
        """Verdict of a new certificate, the stored one, and where they differ."""
        file = path.stem + CERTIFICATE
        name, stored = f"{ROLLOUTS}/{file}", {}
        found: list[Finding] = []
        try:
            stored = read_object(self.run_dir, ROLLOUTS, file, sealed=False)
        except RunError as error:
            found.append(Finding(name, "file", str(error)))
        if check.model is None or faults(check.findings):
            # it is not what it says; what a replay of it would prove is nothing
            return "not_measured", stored, found
        try:
            new = json.loads(certify(rollout, model=check.model).to_json())
        except (FlashdexError, ValueError) as error:
            if is_of_machine(error):
                raise
            return "not_measured", stored, [*found, Finding(name, "model", str(error))]
        if stored:
            found += compare_certificates(stored, new, name)
        return new["verdict"], stored, found

    def _told(
        self,
        line: dict[str, Any] | None,
        path: Path,
        rollout: Rollout,
        stored: dict[str, Any],
        files: dict[str, Path],
    ) -> list[Finding]:
        """The line that names a rollout, against the files whose hashes it holds."""
        file = self._name(path)
        if line is None:
            text = "no line names it; if a crash left it so, 'train --resume' adds one"
            return [Finding(file, "line", text)]
        if line["criterion"] not in criterion_names():
            text = f"criterion {line['criterion']!a} is none"
            return [Finding(CONVERSIONS, file, text)]
        expected = rollout.summary(line["criterion"])
        pairs = [(key, line[key], expected[key]) for key in COUNTED]
        said, found = (_without_end(x["passed"]) for x in (line, expected))
        verdict = stored.get("verdict")
        searched = json.loads(rollout.provenance).get(OF_SEARCH, {})
        pairs += [(key, line.get(key), value) for key, value in searched.items()]
        pairs += [
            ("passed", said, found),
            (
                f"trivial.{UNMOVED}",
                UNMOVED in line["trivial"],
                stays_behind(rollout.tracking_errors()),
            ),
            ("seed", line["seed"], rollout.seed),
            ("engine", line["engine"], json.loads(rollout.versions).get("engine")),
            ("criterion", line["criterion"], rollout.criterion),
            ("verdict", line.get("verdict"), verdict),
            ("survived", line.get("survived"), _survived(stored)),
            ("certified", line["certified"], verdict in PROVEN if verdict else None),
            *(
                (
                    key,
                    line.get(key),
                    hash_content(other, most=MAX_FILE) if other.is_file() else None,
                )
                for key, other in files.items()
            ),
        ]
        return [
            Finding(CONVERSIONS, f"{file}: {text.split(' ')[0]}", text)
            for key, said, right in pairs
            for text in differences(said, right, at=key, tolerance=2e-6)
        ]


def _survived(certificate: dict[str, Any]) -> float | None:
    """Share of perturbed replays that pass, as a stored certificate says."""
    criterion = at(certificate, "identity", "criterion")
    return at(certificate, "perturbed", "pass_fraction", criterion)


def _without_end(passed: list[Any]) -> list[Any]:
    """Criteria but that of terminations, which a file does not hold."""
    return [name for name in passed if not str(name).startswith("completed")]
