"""Metric writers: JSON lines are the truth, CSV and W&B are copies."""

from __future__ import annotations

import csv
import io
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from flashdex.errors import FlashdexError
from flashdex.recipe import RunRecipe
from flashdex.system.files import open_own, open_plain, own_file, own_folder
from flashdex.system.jsonl import append_line, drop_cut_line, keep_lines
from flashdex.system.run_files import CSV, METRICS, WANDB, read_metrics

_LOG = logging.getLogger(__name__)
_OFF = ("offline", "disabled", "dryrun")  # what W&B itself is told not to send
WAIT_S = 30.0  # for W&B's server, when a session begins; and for the last of it


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
        self._path = own_file(run_dir, METRICS)
        drop_cut_line(self._path)
        if env_steps is not None:
            keep_lines(self._path, lambda record: record["env_steps"] <= env_steps)
        self.count = len(read_metrics(run_dir))

    def write(self, record: dict[str, float]) -> None:
        """Append; the record is on the disk then."""
        append_line(self._path, record)
        self.count += 1

    def close(self) -> None:
        """Every record is on the disk already."""


class CsvWriter:
    """Writes ``metrics.csv``; a new key adds a column, empty in the rows above.

    A session begins with what the JSON lines hold, whatever became of the table.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._rows: list[dict[str, Any]] = read_metrics(run_dir)
        self._fields = list(dict.fromkeys(key for row in self._rows for key in row))
        self._rewrite()

    def write(self, record: dict[str, float]) -> None:
        """Append one row."""
        fresh = [key for key in record if key not in self._fields]
        self._rows.append(record)
        if fresh:
            self._fields += fresh
            self._rewrite()
            return
        with open_plain(own_file(self._run_dir, CSV), "ab") as file:
            file.write(self._lines([record]))

    def _lines(self, rows: list[dict[str, Any]], *, head: bool = False) -> bytes:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._fields)
        if head:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue().encode("utf-8")

    def _rewrite(self) -> None:
        with open_own(self._run_dir, CSV) as file:
            file.write(self._lines(self._rows, head=bool(self._fields)))

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
    """Weights & Biases, on its own axes: env steps and hours, never W&B's step.

    Without the server the session is written to files that ``wandb sync`` uploads.
    Those of several sessions never share an id: a sync keeps the last one only
    (wandb/wandb issues 3841 and 5865).
    """

    def __init__(
        self, run_dir: Path, recipe: RunRecipe, *, run_id: str | None = None
    ) -> None:
        self._wandb, c = _import_wandb(), recipe.logger
        own_folder(run_dir, WANDB)  # no link
        options = {"console": "off", "silent": True, "init_timeout": WAIT_S}
        if "finish_timeout" in self._wandb.Settings.model_fields:
            options["finish_timeout"] = WAIT_S
        self._options: dict[str, Any] = {
            "project": c.wandb_project,
            "entity": c.wandb_entity,
            "group": c.wandb_group or recipe.name,
            "name": f"{recipe.name}-{recipe.ablation}-s{recipe.seed}",
            "job_type": "train",
            "tags": [*recipe.tags, *c.wandb_tags],
            "dir": str(run_dir),
            "settings": self._wandb.Settings(**options),
        }
        told = os.environ.get("WANDB_MODE")
        self._run = self._begin(told if told in _OFF else c.wandb_mode, run_id)
        self._run.define_metric("env_steps")
        self._run.define_metric("hours")
        self._run.define_metric("*", step_metric="env_steps")
        # what a later session may go on with
        self.run_id = None if self._run.settings._offline else self._run.id

    def _begin(self, mode: str, run_id: str | None) -> Any:
        if mode == "online":
            again = {"id": run_id, "resume": "allow"} if run_id else {}
            try:
                return self._wandb.init(mode=mode, **again, **self._options)
            except Exception as error:
                _LOG.warning(
                    "W&B is not there (%s): this session is written to files, upload "
                    "them with 'wandb sync'",
                    _first_line(error),
                )
            mode = "offline"
        return self._wandb.init(mode=mode, **self._options)

    def write(self, record: dict[str, float]) -> None:
        """Log one record."""
        self._run.log(record)

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()

    def give_up(self) -> None:
        """Let nothing of W&B act at the end of the process."""
        self._wandb.teardown()


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class Copy:
    """A writer whose failure ends nothing: all of it stands in ``metrics.jsonl``."""

    def __init__(self, name: str, make: Callable[[], Any]) -> None:
        self.name, self.writer = name, None
        self.writer = self._try(make)

    def _try(self, what: Callable[..., Any], *args: Any) -> Any:
        # whatever a foreign package, its process or its server raises
        try:
            return what(*args)
        except Exception as error:
            _LOG.warning(
                "%s is no longer written, the run goes on: %s",
                self.name,
                _first_line(error),
            )
            with suppress(Exception):
                getattr(self.writer, "give_up", lambda: None)()
            self.writer = None
            return None

    def write(self, record: dict[str, float]) -> None:
        """Write one record, if all went well so far."""
        if self.writer is not None:
            self._try(self.writer.write, record)

    def close(self) -> None:
        """Finish, if all went well so far."""
        if self.writer is not None:
            self._try(self.writer.close)


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
        self.lines = JsonlWriter(run_dir, env_steps=env_steps)
        self.writers: list[MetricWriter] = [self.lines]
        self.wandb_id = wandb_id
        if "csv" in recipe.logger.kind:
            self.writers.append(Copy(CSV, lambda: CsvWriter(run_dir)))
        if "wandb" in recipe.logger.kind:
            _import_wandb()
            copy = Copy("W&B", lambda: WandbWriter(run_dir, recipe, run_id=wandb_id))
            self.wandb_id = getattr(copy.writer, "run_id", wandb_id)
            self.writers.append(copy)

    def write(self, record: dict[str, Any]) -> None:
        """Write one record everywhere."""
        clean = {k: float(v) for k, v in record.items()}
        for writer in self.writers:
            writer.write(clean)

    def close(self) -> None:
        """Close all writers."""
        for writer in self.writers:
            writer.close()
