"""``flashdex replay`` and ``verify``: a run's claims against what can be recomputed.

Files are bound to one another by hashes: a rollout names recipe, library and reference,
a certificate its rollout, a line of the ledger both files, each line the one before.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flashdex.errors import FlashdexError, RunError
from flashdex.metrics.criteria import criterion_names, stays_behind
from flashdex.metrics.tally import UNMOVED
from flashdex.rollouts.certificate import PROVEN, certify, compare_certificates
from flashdex.rollouts.checks import RolloutCheck
from flashdex.rollouts.claims import RunClaims, read_json
from flashdex.rollouts.findings import OLD, Finding, differences
from flashdex.rollouts.ledger import (
    CONVERSIONS,
    ROLLOUTS,
    rollout_name,
)
from flashdex.rollouts.rollout import MAX_FILE, Rollout
from flashdex.rollouts.truth import Truth
from flashdex.system.arrays import hash_content
from flashdex.system.files import own_file, own_files
from flashdex.system.names import file_stem
from flashdex.system.run_files import (
    MOTIONS,
    RECIPE,
    check_run,
    read_recipe,
)

CERTIFICATE = ".certificate.json"
# of a line: what is counted from the rollout it names
COUNTED = ("motion", "converted", "criterion", "errors", "hands", "frame", "env_steps")
RATIOS = ("lift_ratio", "path_ratio")


@dataclass(frozen=True)
class Replayed:
    """One stored rollout: what the run says of it, and what was found."""

    motion: str
    stored: str | None  # verdict in the run's files, None when there is none
    found: str  # verdict of the certificate made now
    findings: tuple[Finding, ...]  # of rollout, certificate and its line

    @property
    def faults(self) -> list[Finding]:
        """What is not as it should be."""
        return [finding for finding in self.findings if finding.is_fault]

    @property
    def holds(self) -> bool:
        """The conversion is proven, and the files say so truthfully."""
        return not self.faults and self.found in PROVEN


@dataclass(frozen=True)
class Verified:
    """What was found in a run."""

    rollouts: list[Replayed]
    ledger: list[Finding]  # of the lines, and of files that no line names

    @property
    def findings(self) -> list[Finding]:
        """All, those of the ledger first."""
        return [*self.ledger, *(f for one in self.rollouts for f in one.findings)]

    @property
    def holds(self) -> bool:
        """Every stored rollout is proven, and the lines are those of the run."""
        no_fault = not any(finding.is_fault for finding in self.ledger)
        return no_fault and all(one.holds for one in self.rollouts)


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

    def run(self) -> Verified:
        check_run(self.run_dir)  # a link under the name of any file of a run
        files = own_files(self.run_dir, ROLLOUTS, "*.npz")
        lines = self.claims.lines()
        told = {x["motion"]: x for x in lines if x.get("rollout")}  # the newest
        if not files and not told:
            raise RunError(
                f"{self.run_dir}: no stored rollout in '{ROLLOUTS}/'. Either nothing "
                "has been converted yet, or this is not a run directory."
            )
        names = {file.name for file in files}
        for motion in told:
            if Path(rollout_name(motion)).name not in names:
                self.claims.fault(motion, f"its {rollout_name(motion)} is missing")
        found = [self._one(file, told) for file in files]
        for path in own_files(self.run_dir, ROLLOUTS, f"*{CERTIFICATE}"):
            if path.name.removesuffix(CERTIFICATE) + ".npz" not in names:
                self.claims.fault("certificate", "of no rollout", file=self._name(path))
        if self.claims.is_bound:
            found = [replace(one, findings=_too_old(one.findings)) for one in found]
        return Verified(found, self.claims.findings)

    def _name(self, path: Path) -> str:
        return f"{ROLLOUTS}/{path.name}"

    def _one(self, path: Path, told: dict[str, dict[str, Any]]) -> Replayed:
        file = self._name(path)
        try:
            rollout = Rollout.load(path)
        except FlashdexError as error:
            stem = path.stem
            line = next((x for m, x in told.items() if file_stem(m) == stem), {})
            fault = Finding(file, "file", str(error))
            return Replayed(stem, line.get("verdict"), "not_measured", (fault,))
        found = self._bound(rollout, file)
        check = RolloutCheck(
            rollout,
            file,
            self.truth,
            is_current=all(f.is_fault or f.what != "recipe" for f in found),
        )
        found += check.run()
        if file != rollout_name(rollout.motion):
            found.append(Finding(file, "motion", f"is that of '{rollout.motion}'"))
        verdict, stored, compared = self._certificate(path, rollout, check)
        line = told.get(rollout.motion)
        found += compared
        if check.is_sound:
            found += self._told(line, path, rollout, stored)
        return Replayed(rollout.motion, stored.get("verdict"), verdict, tuple(found))

    def _bound(self, rollout: Rollout, file: str) -> list[Finding]:
        """Recipe, library and motion that the rollout was made by."""
        said, found = json.loads(rollout.provenance), []
        if "reference_sha256" not in said:
            found.append(Finding(file, "hashes", OLD, is_fault=False))
        if "recipe_sha256" in said and (self.run_dir / RECIPE).exists():
            sha = self._recipe_sha256()
            if said["recipe_sha256"] != sha:
                changed = self.claims.was_overridden()
                text = "recipe.yaml is another than it was made by"
                text += ", as --resume changed it" if changed else ""
                found.append(Finding(file, "recipe", text, is_fault=not changed))
        known = self.claims.motions.get(rollout.motion)
        if self.claims.motions and said.get("motion_sha256", known) != known:
            text = f"the motion is another than that of {MOTIONS}"
            found.append(Finding(file, "motion", text))
        if self.truth is None:
            return found
        library = self.truth.library
        # older versions named a file's hash, of libraries that are not read any more
        is_bound = "reference_sha256" in said
        if is_bound and said.get("library_sha256") != library.content_hash:
            text = f"{library.path} is another than it was made from"
            found.append(Finding(file, "library", text))
        names = self.truth.bank.names
        if "motion_sha256" in said and rollout.motion in names:
            sha = library.motion_hash(names.index(rollout.motion))
            if said["motion_sha256"] != sha:
                text = "the library has another motion of that name"
                found.append(Finding(file, "motion", text))
        return found

    def _recipe_sha256(self) -> str:
        try:
            recipe = read_recipe(self.run_dir)
        except RunError:
            return ""  # of no recipe
        return hashlib.sha256(recipe.encode()).hexdigest()

    def _certificate(
        self, path: Path, rollout: Rollout, check: RolloutCheck
    ) -> tuple[str, dict[str, Any], list[Finding]]:
        """Verdict of a new certificate, the stored one, and where they differ."""
        file = own_file(self.run_dir, ROLLOUTS, path.stem + CERTIFICATE)
        name, stored = self._name(file), {}
        found: list[Finding] = []
        if file.is_file():
            stored, fault = read_json(file)
            found += [Finding(name, "file", fault)] if fault else []
        if check.model is None or faults(check.findings):
            # it is not what it says; what a replay of it would prove is nothing
            return "not_measured", stored, found
        try:
            new = json.loads(certify(rollout, model=check.model).to_json())
        except (FlashdexError, ValueError) as error:
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
    ) -> list[Finding]:
        """The line that names a rollout, against the files."""
        file = self._name(path)
        if line is None:
            text = "no line names it; if a crash left it so, 'train --resume' adds one"
            return [Finding(file, "line", text)]
        if line["criterion"] not in criterion_names():
            text = f"criterion {line['criterion']!a} is none"
            return [Finding(CONVERSIONS, file, text)]
        expected = rollout.summary(line["criterion"])
        pairs = [(key, line.get(key), expected[key]) for key in COUNTED]
        new = "rollout_sha256" in line
        pairs += [(key, line.get(key), expected[key]) for key in RATIOS if new]
        if new:
            has = UNMOVED in (line.get("trivial") or [])
            unmoved = stays_behind(rollout.tracking_errors())
            pairs.append((f"trivial.{UNMOVED}", has, unmoved))
        pairs.append(("seed", line.get("seed"), rollout.seed))
        if self.claims.is_bound:
            said, found = (_without_end(x.get("passed", [])) for x in (line, expected))
            pairs.append(("passed", said, found))
            made_by = json.loads(rollout.versions).get("engine")
            pairs.append(("engine", line.get("engine"), made_by))
            pairs.append(("criterion", line["criterion"], rollout.criterion))
        pairs.append(("verdict", line.get("verdict"), stored.get("verdict")))
        is_proven = stored.get("verdict") in PROVEN if stored else None
        if "verdict" in line or stored:
            pairs.append(("certified", line.get("certified"), is_proven))
        certificate = path.with_name(path.stem + CERTIFICATE)
        hashes = {"rollout_sha256": path, "certificate_sha256": certificate}
        found = []
        for key, other in hashes.items():
            if not new:
                found.append(Finding(CONVERSIONS, f"{key} of {file}", OLD, False))
            elif other.is_file() or key in line:
                sha = hash_content(other, most=MAX_FILE) if other.is_file() else None
                pairs.append((key, line.get(key), sha))
        return found + [
            Finding(CONVERSIONS, f"{file}: {text.split(' ')[0]}", text)
            for key, said, right in pairs
            for text in differences(said, right, at=key, tolerance=2e-6)
        ]


def _without_end(passed: list[Any]) -> list[Any]:
    """Criteria but that of terminations, which a file does not hold."""
    return [name for name in passed if not str(name).startswith("completed")]


def _too_old(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those of a run that has an id: what it does not bind was taken out of it."""
    text = "is not bound, in a run of a version that binds it"
    return tuple(
        replace(f, text=text, is_fault=True) if f.text == OLD else f for f in findings
    )


def faults(findings: Iterable[Finding]) -> list[Finding]:
    """Those that are not only unchecked."""
    return [finding for finding in findings if finding.is_fault]
