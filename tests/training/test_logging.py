"""Metric writers: what goes in comes out of every file, W&B's offline run included."""

import csv
import time
from dataclasses import replace
from pathlib import Path

import pytest

from flashdex.errors import FlashdexError
from flashdex.recipe import LoggerConfig, Recipe, compose
from flashdex.system.jsonl import read_lines
from flashdex.training.logging import Copy, MetricLog, check_writers
from flashdex.training.run_dir import train

RECORDS = [
    {"env_steps": 48, "hours": 0.01, "convert/cumulative": 0.0},
    {"env_steps": 96, "hours": 0.02, "convert/cumulative": 2.0},
]


def write_records(run_dir: Path, **logger) -> MetricLog:
    recipe = Recipe(name="tiny", total_env_steps=100, logger=LoggerConfig(**logger))
    log = MetricLog(run_dir, recipe)
    for record in RECORDS:
        log.write(record)
    log.close()
    return log


def test_json_lines_are_written_whatever_the_recipe_names(tmp_path):
    write_records(tmp_path, kind=["csv"])
    assert read_lines(tmp_path / "metrics.jsonl") == RECORDS
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["convert/cumulative"]) for r in rows] == [0.0, 2.0]


def test_csv_keeps_its_columns_after_a_resume(tmp_path):
    write_records(tmp_path, kind=["csv"])
    write_records(tmp_path, kind=["csv"])
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines[0] == "env_steps,hours,convert/cumulative"
    assert len(lines) == 5


def test_wandb_offline_run_holds_the_records(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    log = write_records(tmp_path, kind=["wandb"], wandb_mode="offline")
    assert log.wandb_id is None  # a sync of a second session would replace this one
    files = list(tmp_path.glob("wandb/offline-run-*/run-*.wandb"))
    assert len(files) == 1
    # the store is binary; keys of the history stand in it as text. W&B's own process
    # writes it and may still be at it.
    end = time.monotonic() + 30
    while b"convert/cumulative" not in files[0].read_bytes():
        assert time.monotonic() < end, "the history never reached the file"
        time.sleep(0.1)
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == len(RECORDS)


def test_wandb_is_named_when_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    recipe = Recipe(name="tiny", total_env_steps=100)
    recipe = replace(recipe, logger=LoggerConfig(kind=["wandb"]))
    with pytest.raises(FlashdexError, match="pip install wandb"):
        MetricLog(tmp_path, recipe)


def test_a_line_that_a_crash_cut_off_is_removed(tmp_path):
    write_records(tmp_path, kind=["jsonl"])
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text() + '{"env_steps": 14')
    write_records(tmp_path, kind=["jsonl"])
    assert read_lines(path) == RECORDS + RECORDS


class Broken:
    """A W&B whose process dies after some calls."""

    def __init__(self, calls):
        self.calls, self.records, self.gave_up = calls, [], False

    def write(self, record):
        self.calls -= 1
        if self.calls < 0:
            raise ConnectionResetError("Connection lost")
        self.records.append(record)

    def close(self):
        self.write({})

    def give_up(self):
        self.gave_up = True


@pytest.mark.parametrize("calls", [0, 1, 2])
def test_a_copy_that_fails_ends_nothing(tmp_path, caplog, calls):
    recipe = Recipe(name="tiny", total_env_steps=100)
    log, broken = MetricLog(tmp_path, recipe), Broken(calls)
    log.writers.append(Copy("W&B", lambda: broken))
    for record in RECORDS:
        log.write(record)
    log.close()
    assert read_lines(tmp_path / "metrics.jsonl") == RECORDS
    assert broken.records == RECORDS[:calls]
    assert broken.gave_up
    assert caplog.text.count("W&B is no longer written") == 1


def test_a_copy_that_never_begins_ends_nothing(tmp_path, caplog):
    def fail():
        raise RuntimeError("no server")

    copy = Copy("W&B", fail)
    copy.write(RECORDS[0])
    copy.close()
    assert "W&B is no longer written, the run goes on: no server" in caplog.text


@pytest.mark.parametrize("spoil", ["", "garbage\n\xff", "env_steps\nabc\n"])
def test_a_spoilt_table_is_made_again(tmp_path, spoil):
    write_records(tmp_path, kind=["csv"])
    (tmp_path / "metrics.csv").write_text(spoil, encoding="latin-1")
    write_records(tmp_path, kind=["csv"])
    with (tmp_path / "metrics.csv").open() as file:
        assert [float(r["hours"]) for r in csv.DictReader(file)] == [0.01, 0.02] * 2


def test_without_a_server_the_session_is_written_to_files(
    tmp_path, monkeypatch, caplog
):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    init = wandb.init

    def no_network(*args, mode, **options):
        if mode == "online":
            raise ConnectionError("no route to host")
        return init(*args, mode=mode, **options)

    monkeypatch.setattr(wandb, "init", no_network)
    ids = set()
    for _ in range(2):  # two sessions: a sync keeps both only if no id is shared
        write_records(tmp_path, kind=["wandb"])
    for file in tmp_path.glob("wandb/offline-run-*/run-*.wandb"):
        ids.add(file.stem)
    assert len(ids) == 2
    assert "W&B is not there (no route to host)" in caplog.text
    assert len(read_lines(tmp_path / "metrics.jsonl")) == 2 * len(RECORDS)


def refuse(**_):
    raise OSError("no route to host")


@pytest.mark.parametrize(
    ("login", "expected"),
    [(lambda **_: False, "has no key"), (refuse, "no route to host")],
    ids=["no_key", "no_network"],
)
def test_wandb_is_asked_before_anything_is_made(tmp_path, monkeypatch, login, expected):
    import wandb

    monkeypatch.setattr(wandb, "login", login)
    monkeypatch.setattr(wandb, "setup", lambda **_: None)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    recipe = compose("quickstart", ["logger=wandb", f"run_dir={tmp_path / 'run'}"])
    with pytest.raises(FlashdexError, match=expected) as caught:
        train(recipe)
    assert "logger.wandb_mode=offline" in str(caught.value)
    assert not (tmp_path / "run").exists()
    for change in (["logger.wandb_mode=offline"], ["logger.kind=[csv]"]):
        check_writers(compose("quickstart", ["logger=wandb", *change]))  # asks nobody
