"""Reads a run directory; whatever a young or old run lacks is empty, never an error."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from flashdex.errors import RunError

Line = dict[str, Any]
ATTEMPT_KEYS = ("motion", "converted", "errors", "env_steps", "wall_s")


@dataclass(frozen=True)
class RunData:
    """The files of a run, as plain data.

    Args:
        path: run directory.
        recipe: composed recipe.
        versions: package versions, and hardware when it was recorded.
        metrics: records of ``metrics.jsonl``; what a resumed run did again is left out.
        attempts: lines of ``conversions.jsonl``, oldest first.
        baselines: baseline -> motion -> score.
        certificates: motion -> certificate, of stored rollouts.
    """

    path: Path
    recipe: Line
    versions: Line
    metrics: list[Line]
    attempts: list[Line]
    baselines: dict[str, dict[str, Line]]
    certificates: dict[str, Line]

    @property
    def criterion(self) -> str:
        """Name of the criterion that counts as a conversion."""
        return str(self.recipe.get("train", {}).get("criterion", "sr_mt_obj"))

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
    """Read a run directory.

    Args:
        run_dir: folder with a ``recipe.yaml``.

    Raises:
        RunError: this is no run directory, or a file in it is broken.
    """
    path = Path(run_dir)
    recipe = path / "recipe.yaml"
    if not recipe.is_file():
        raise RunError(
            f"{path}: not a run directory, there is no recipe.yaml in it. Give the "
            "folder that 'flashdex train' wrote, usually runs/<name>."
        )
    try:
        composed = yaml.safe_load(recipe.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise RunError(f"{recipe}: not YAML ({error}). Restore the file.") from error
    return RunData(
        path=path,
        recipe=composed if isinstance(composed, dict) else {},
        versions=read_json(path / "versions.json"),
        metrics=_drop_repeated(
            read_lines(path / "metrics.jsonl", needs=("env_steps",))
        ),
        attempts=read_lines(path / "conversions.jsonl", needs=ATTEMPT_KEYS),
        baselines=read_json(path / "baselines.json"),
        certificates=_certificates(path / "rollouts"),
    )


def read_json(path: Path) -> Line:
    """Read a JSON object; a file that does not exist is an empty one.

    Args:
        path: the file.
    """
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(f"{path}: not JSON ({error}). Restore or remove it.") from error
    if not isinstance(found, dict):
        raise RunError(f"{path}: not a JSON object. Restore or remove it.")
    return found


def read_lines(path: Path, *, needs: tuple[str, ...]) -> list[Line]:
    """Read JSON lines; a last line that a crash cut off is left out.

    Args:
        path: the file; an absent one has no lines.
        needs: keys that every line has.

    Raises:
        RunError: a line before the last is broken, or lacks a key.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    found = []
    for number, text in enumerate(lines, start=1):
        try:
            line = json.loads(text)
        except ValueError as error:
            if number == len(lines):
                break
            raise RunError(
                f"{path}: line {number} is not JSON ({error}). Remove the line."
            ) from error
        absent = [key for key in needs if not isinstance(line, dict) or key not in line]
        if absent:
            raise RunError(
                f"{path}: line {number} lacks {', '.join(absent)}. Remove the line."
            )
        found.append(line)
    return found


def _drop_repeated(records: list[Line]) -> list[Line]:
    """Keep records whose env steps no later record has reached again."""
    kept: list[Line] = []
    for record in reversed(records):
        if not kept or record.get("env_steps", 0) < kept[-1].get("env_steps", 0):
            kept.append(record)
    return kept[::-1]


def _certificates(folder: Path) -> dict[str, Line]:
    found = {}
    for path in sorted(folder.glob("*.certificate.json")):
        certificate = read_json(path)
        name = certificate.get("identity", {}).get("motion")
        found[name or path.name.removesuffix(".certificate.json")] = certificate
    return found
