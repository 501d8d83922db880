"""``flashdex replay``: recompute every certificate of a run from its files alone."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.rollouts.certificate import PROVEN, certify
from flashdex.rollouts.ledger import CONVERSIONS, ROLLOUTS
from flashdex.rollouts.rollout import Rollout
from flashdex.system.jsonl import read_lines


@dataclass(frozen=True)
class Replayed:
    """One recomputed certificate."""

    motion: str
    stored: str | None  # verdict in the run's files, None when there is none
    found: str  # verdict of this replay
    agrees: bool  # both are the same, with nominal errors equal to 1e-9

    @property
    def holds(self) -> bool:
        """The conversion is proven, and the files say so truthfully."""
        return self.agrees and self.found in PROVEN


def replay(run: str | Path) -> list[Replayed]:
    """Re-simulate every stored rollout of a run in MuJoCo C; compare the certificates.

    Raises:
        RunError: there is nothing to replay, or a file is broken.
    """
    run_dir = Path(run)
    files = sorted((run_dir / ROLLOUTS).glob("*.npz"))
    claimed = [row for row in read_lines(run_dir / CONVERSIONS) if row.get("rollout")]
    if not files and not claimed:
        raise RunError(
            f"{run_dir}: no stored rollout in '{ROLLOUTS}/'. Either nothing has been "
            "converted yet, or this is not a run directory."
        )
    missing = [r["rollout"] for r in claimed if not (run_dir / r["rollout"]).is_file()]
    if missing:
        raise RunError(
            f"{run_dir}: {CONVERSIONS} names {missing[0]}, which is missing. A "
            "conversion without its rollout cannot be proven; restore the file."
        )
    proven = {row["motion"] for row in claimed if row["certified"]}
    return [_replay_one(file, proven) for file in files]


def _replay_one(file: Path, proven: set[str]) -> Replayed:
    rollout = Rollout.load(file)
    found = certify(rollout)
    path = file.with_suffix(".certificate.json")
    if not path.is_file():
        # The run may not claim a proof that it does not hold.
        agrees = rollout.motion not in proven
        return Replayed(rollout.motion, None, found.verdict, agrees=agrees)
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(f"{path}: not JSON ({error}). Restore or delete it.") from error
    agrees = stored["verdict"] == found.verdict and _same_numbers(
        stored["nominal"], json.loads(found.to_json())["nominal"]
    )
    return Replayed(rollout.motion, stored["verdict"], found.verdict, agrees)


def _same_numbers(stored: dict[str, Any], found: dict[str, Any]) -> bool:
    return all(
        name in found
        and found[name]["state"] == verdict["state"]
        and all(
            value is None or abs(value - found[name]["values"][key]) <= 1e-9
            for key, value in verdict["values"].items()
        )
        for name, verdict in stored.items()
    )
