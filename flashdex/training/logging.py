"""Metric writers: JSON lines are the truth, CSV and W&B are copies."""

from __future__ import annotations

import csv
import io
import json
import os
from pathlib import Path
from typing import Any, Protocol

from flashdex.errors import FlashdexError
from flashdex.recipe import RunRecipe
from flashdex.system.files import write_atomic
from flashdex.system.jsonl import drop_cut_line, keep_lines

METRICS = "metrics.jsonl"
_OFF = ("offline", "disabled", "dryrun")  # what W&B itself is told not to send


class MetricWriter(Protocol):
    """Takes one record at a time; each holds ``env_steps``."""

    def write(self, record: dict[str, float]) -> None:
        """Write one record."""
        ...

    def close(self) -> None:
        """Finish."""
        ...


class JsonlWriter:
    """Appends one JSON object a record to ``metrics.jsonl``.

    Records beyond ``env_steps``, of the checkpoint that a resumed run goes on from,
    belong to steps that are done again, and are removed.
    """

    def __init__(self, run_dir: Path, *, env_steps: int | None = None) -> None:
        path = run_dir / METRICS
        drop_cut_line(path)
        if env_steps is not None:
            keep_lines(path, lambda record: record["env_steps"] <= env_steps)
        self._file = path.open("a", encoding="utf-8")
        self.close = self._file.close

    def write(self, record: dict[str, float]) -> None:
        """Append and flush."""
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()


class CsvWriter:
    """Writes ``metrics.csv``; a new key adds a column, empty in the rows above."""

    def __init__(self, run_dir: Path, *, env_steps: int | None = None) -> None:
        self._path = run_dir / "metrics.csv"
        drop_cut_line(self._path)
        self._fields, rows = self._read()
        if env_steps is not None:
            kept = [r for r in rows if float(r["env_steps"]) <= env_steps]
            if len(kept) < len(rows):
                self._rewrite(kept)

    def _read(self) -> tuple[list[str], list[dict[str, str]]]:
        if not self._path.is_file():
            return [], []
        with self._path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            return list(reader.fieldnames or []), list(reader)

    def write(self, record: dict[str, float]) -> None:
        """Append one row."""
        fresh = [key for key in record if key not in self._fields]
        if fresh:
            _, rows = self._read()
            self._fields += fresh
            self._rewrite(rows)
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self._fields).writerow(record)

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._fields)
        writer.writeheader()
        writer.writerows(rows)
        write_atomic(self._path, text.getvalue())

    def close(self) -> None:
        """Every row is on disk already."""


def check_writers(recipe: RunRecipe) -> None:
    """Refuse a recipe whose writers could not begin, before anything is made for it.

    Raises:
        FlashdexError: W&B is not installed, has no key, or cannot be reached; it says
            how to go on without the network.
    """
    if "wandb" not in recipe.logger.kind:
        return
    wandb = _import_wandb()
    if recipe.logger.wandb_mode == "offline" or os.environ.get("WANDB_MODE") in _OFF:
        return
    wandb.setup(settings=wandb.Settings(silent=True))
    try:
        problem = "" if wandb.login(prompt=False) else "has no key (`wandb login` once)"
    except TypeError:  # an older W&B cannot be asked without a prompt
        return
    except Exception as error:  # its own errors, and those of whatever carries it
        problem = f"does not answer ({' '.join(str(error).split())[:200]})"
    if problem:
        raise FlashdexError(
            f"logger.kind: W&B {problem}. Or add logger.wandb_mode=offline, which "
            "keeps the records in the run's folder for `wandb sync`, or take wandb out "
            "of logger.kind; metrics.jsonl is written in any case."
        )


def _import_wandb() -> Any:
    try:
        import wandb
    except ImportError as error:
        raise FlashdexError(
            "logger.kind: 'wandb' is named, but the package is not installed. "
            "Install it (pip install wandb) or take it out of logger.kind."
        ) from error
    return wandb


class WandbWriter:
    """Weights & Biases, on its own axes: env steps and hours, never W&B's step."""

    def __init__(
        self, run_dir: Path, recipe: RunRecipe, *, run_id: str | None = None
    ) -> None:
        wandb = _import_wandb()
        c = recipe.logger
        self._run = wandb.init(
            project=c.wandb_project,
            entity=c.wandb_entity,
            group=c.wandb_group or recipe.name,
            name=f"{recipe.name}-{recipe.ablation}-s{recipe.seed}",
            job_type="train",
            tags=[*recipe.tags, *c.wandb_tags],
            mode=c.wandb_mode,
            dir=str(run_dir),
            id=run_id,
            resume="allow" if run_id else None,
            settings=wandb.Settings(console="off", silent=True),
        )
        self._run.define_metric("env_steps")
        self._run.define_metric("hours")
        self._run.define_metric("*", step_metric="env_steps")
        self.run_id = self._run.id

    def write(self, record: dict[str, float]) -> None:
        """Log one record."""
        self._run.log(record)

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


class MetricLog:
    """Sends each record to all writers of the recipe; see those for the arguments."""

    def __init__(
        self,
        run_dir: Path,
        recipe: RunRecipe,
        *,
        wandb_id: str | None = None,
        env_steps: int | None = None,
    ) -> None:
        self.writers: list[MetricWriter] = [JsonlWriter(run_dir, env_steps=env_steps)]
        self.wandb_id = wandb_id
        if "csv" in recipe.logger.kind:
            self.writers.append(CsvWriter(run_dir, env_steps=env_steps))
        if "wandb" in recipe.logger.kind:
            writer = WandbWriter(run_dir, recipe, run_id=wandb_id)
            self.wandb_id = writer.run_id
            self.writers.append(writer)

    def write(self, record: dict[str, Any]) -> None:
        """Write one record everywhere."""
        clean = {k: float(v) for k, v in record.items()}
        for writer in self.writers:
            writer.write(clean)

    def close(self) -> None:
        """Close all writers."""
        for writer in self.writers:
            writer.close()
