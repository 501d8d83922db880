"""Resumed runs: bit-equal learning, continuous curves, nothing stored is lost."""

from __future__ import annotations

import csv
import errno
import itertools
import os
import signal
import threading
from contextlib import contextmanager, suppress

import pytest
import torch

from flashdex.cli.main import main
from flashdex.errors import RunError
from flashdex.motions.library import MotionLibrary
from flashdex.replay.disk import ReplayLog
from flashdex.rollouts.ledger import CONVERSIONS, Ledger
from flashdex.rollouts.rollout import Rollout
from flashdex.system.files import run_lock
from flashdex.system.jsonl import (
    append_line,
    keep_lines,
    read_lines,
    read_object,
    write_object,
)
from flashdex.system.run_files import MOTIONS, SESSIONS
from flashdex.training import checkpoint
from flashdex.training.checkpoint import load_checkpoint, save_checkpoint
from flashdex.training.run_dir import evaluate, resume
from flashdex.training.session import (
    StopSignals,
    begin_session,
    end_session,
    ended_by,
    interruptible,
)

KEYS = ("env_steps", "hours", "updates")


def metrics(run_dir):
    return read_lines(run_dir / "metrics.jsonl")


@pytest.mark.parametrize("rows", [400, 90])
@pytest.mark.parametrize("groups", ["per_hand", "unified"])
def test_updates_go_on_bit_equal_through_files(
    make_bench, collect, tmp_path, groups, rows
):
    bench = make_bench(6, algo={"groups": groups, "buffer_size": rows})
    env = bench.make_env()
    one, two = bench.make_learner(env), bench.make_learner(env)
    td = collect(env, one, 30)  # 168 rows: more than the small ring holds
    for _ in range(5):
        one.update()
    log = ReplayLog(tmp_path, one.buffer, meaning="m")
    state = {"env_steps": 180, "learner": one.state_dict()}
    save_checkpoint(tmp_path, state, keep=1, replay=log)
    two.load_state_dict(load_checkpoint(tmp_path)["learner"])
    assert ReplayLog(tmp_path, two.buffer, meaning="m").load(f"{180:012d}")
    assert two.num_rows == one.num_rows
    for _ in range(25):
        a, b = one.update(), two.update()
        assert all(torch.equal(a[k], b[k]) for k in a.keys(True, True))
    ours, theirs = (x.agent.loss.state_dict() for x in (one, two))
    assert all(torch.equal(ours[k], theirs[k]) for k in ours)
    assert torch.equal(one.act(td), two.act(td))
    assert one.num_updates() == two.num_updates()


def test_a_resumed_run_has_its_rows_and_learns_on(train_tiny, caplog):
    caplog.set_level("INFO")
    run_dir = train_tiny(train={"checkpoint_replay": True})
    before = metrics(run_dir)[-1]
    state = load_checkpoint(run_dir)
    assert state["env_steps"] == before["env_steps"]
    assert "critic_width: 16" in state["recipe"]
    assert state["ledger_bytes"] == (run_dir / CONVERSIONS).stat().st_size
    resume(run_dir, ["total_env_steps=480"])
    after = metrics(run_dir)
    assert f"{before['buffer/rows']:.0f} replay rows are back" in caplog.text
    assert after[-1]["updates"] == before["updates"] + 20  # 120 env steps, no warm-up
    assert all(a[k] < b[k] for a, b in itertools.pairwise(after) for k in KEYS[:2])


def test_without_rows_the_policy_fills_the_buffer_first(train_tiny):
    run_dir = train_tiny()
    before = metrics(run_dir)[-1]
    resume(run_dir, ["total_env_steps=480"])
    after = metrics(run_dir)[-1]
    # 40 rows are there after 7 + 1 vector steps (n_step = 2): the other 12 may learn
    assert after["updates"] == before["updates"] + 12
    assert not (run_dir / "checkpoints/replay").exists()


def lose(run_dir, *, steps, hours):
    """What a session leaves behind that was killed after its last checkpoint."""
    last = metrics(run_dir)[-1]
    for share in (0.5, 1.0):
        record = {**last, "env_steps": last["env_steps"] + share * steps}
        record["hours"] += share * hours
        append_line(run_dir / "metrics.jsonl", record)
        with (run_dir / "metrics.csv").open("a", newline="") as file:
            csv.DictWriter(file, list(record)).writerow(record)
    return last


def test_lost_records_go_and_lost_time_stays(train_tiny):
    run_dir = train_tiny(logger={"kind": ["csv"]})
    whole = metrics(run_dir)
    last = lose(run_dir, steps=600, hours=1.0)
    line = read_lines(run_dir / CONVERSIONS)[-1]
    seconds = 3600 * (last["hours"] + 2.0)
    steps = int(last["env_steps"]) + 630
    append_line(run_dir / CONVERSIONS, {**line, "env_steps": steps, "wall_s": seconds})
    resume(run_dir, ["total_env_steps=720"])
    after = metrics(run_dir)
    assert after[: len(whole)] == whole
    assert after[-1]["env_steps"] == 720
    assert all(a[k] < b[k] for a, b in itertools.pairwise(after) for k in KEYS[:2])
    assert after[len(whole)]["hours"] >= last["hours"] + 2.0
    assert after[-1]["env_steps_lost"] == 630
    assert after[-1]["convert/attempts"] >= last["convert/attempts"] + 1
    with (run_dir / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["env_steps"]) for r in rows] == [r["env_steps"] for r in after]
    assert set(rows[-1]) >= set(after[-1])


def test_resumes_that_come_to_nothing_count_nothing_twice(tmp_path):
    def begin():
        return begin_session(tmp_path, env_steps=100, wall_s=50.0, overrides=["a=1"])

    def record(steps, seconds):
        line = {"env_steps": steps, "hours": seconds / 3600}
        append_line(tmp_path / "metrics.jsonl", line)

    write_object({"run": "0" * 32}, tmp_path, "versions.json")
    record(100, 50.0)
    record(160, 80.0)
    first = begin()  # killed before it cuts the records off
    second = begin()  # cuts, and is killed before it writes a record
    keep_lines(tmp_path / "metrics.jsonl", lambda line: line["env_steps"] <= 100)
    third = begin()
    for start in (first, second, third):
        assert (start.env_steps, start.lost) == (100, 60)
        assert start.wall_s == pytest.approx(80.0)
    record(130, 95.0)
    assert begin().lost == 90
    assert ended_by(tmp_path) == ""
    end_session(tmp_path, "budget", env_steps=200, wall_s=120.0)
    assert ended_by(tmp_path) == "budget"
    lines = read_lines(tmp_path / SESSIONS)
    assert [x["event"] for x in lines] == ["start"] * 4 + ["end"]
    assert lines[0]["overrides"] == ["a=1"]


def test_a_run_killed_before_its_first_checkpoint_starts_over(train_tiny):
    run_dir = train_tiny()
    hours = metrics(run_dir)[-1]["hours"]
    attempts = len(read_lines(run_dir / CONVERSIONS))
    for path in (run_dir / "checkpoints").glob("*.pt"):
        path.unlink()
    resume(run_dir)
    after = metrics(run_dir)
    assert after[-1]["env_steps"] == after[-1]["env_steps_lost"] == 360
    assert after[0]["hours"] > hours
    assert after[-1]["convert/attempts"] > attempts


def test_an_override_that_does_not_fit_leaves_the_run_as_it_was(train_tiny):
    run_dir = train_tiny()
    kept = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    with pytest.raises(RunError, match="does not fit the recipe"):
        resume(run_dir, ["algo.critic_width=32"])
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == kept


def test_two_processes_never_share_a_run(train_tiny):
    run_dir = train_tiny()
    with run_lock(run_dir), pytest.raises(RunError, match="another process"):
        resume(run_dir)


def test_a_run_outlives_a_checkpoint_that_fails(
    start_tiny, tmp_path, caplog, monkeypatch
):
    def fail(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_tensors", fail)
    run_dir = tmp_path / "run"
    with pytest.raises(RunError, match="cannot be written"):
        start_tiny(run_dir, train={"checkpoint_every_s": 1e-9})
    assert "no checkpoint this time, the run goes on" in caplog.text
    assert metrics(run_dir)[-1]["env_steps"] == 360
    assert ended_by(run_dir) == "error"


@contextmanager
def signal_when_it_trains(number, folder):
    """Send this process a signal once a run below the folder writes records."""
    ended = threading.Event()

    def wait():
        while not ended.wait(0.05):
            if any(p.stat().st_size for p in folder.rglob("metrics.jsonl")):
                os.kill(os.getpid(), number)
                return

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_sigterm_ends_a_run_with_a_checkpoint(start_tiny, tmp_path):
    with signal_when_it_trains(signal.SIGTERM, tmp_path):
        run_dir = start_tiny(tmp_path / "run", total_env_steps=10_000_000)
    assert ended_by(run_dir) == "signal"
    assert metrics(run_dir)[-1]["env_steps"] == load_checkpoint(run_dir)["env_steps"]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_ctrl_c_twice_stops_at_once_and_sigterm_twice_does_not():
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.requested


def test_an_interrupted_multirun_does_not_go_on(library, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["env.num_envs=4", "env.attempt_share=0.5", "algo.min_buffer=1000000"]
    small += ["algo.buffer_size=1000000", "total_env_steps=2000000"]
    words = ["train", "quickstart", "-m", "seed=0,1", f"motions.library={library.path}"]
    with signal_when_it_trains(signal.SIGINT, tmp_path):
        assert main([*words, *small, "train.log_every_s=0.2"]) == 0
    runs = sorted(p.parent.name for p in tmp_path.rglob("recipe.yaml"))
    assert runs == ["0"]
    assert "--resume" in capsys.readouterr().out


# what a crash leaves between a stored rollout and its line


@pytest.fixture
def passing(converted_run):
    """A rollout that a run found to pass, and stored."""
    return Rollout.load(converted_run / "rollouts/right_box.npz")


def open_ledger(folder, library, **changes):
    settings = {"criterion": "sr_mt_obj", "seed": 3, "engine": "cpu", "certify": True}
    return Ledger(folder, library.names, **{**settings, **changes})


def cut_line(folder):
    path = folder / CONVERSIONS
    lines = path.read_text().splitlines(keepends=True)
    (*_, line) = read_lines(path)
    path.write_text("".join(lines[:-1]))
    return line


@pytest.mark.parametrize("certificate", [True, False])
def test_a_rollout_without_a_line_is_adopted(tmp_path, library, passing, certificate):
    open_ledger(tmp_path, library).record(passing, wall_s=2.0)
    line = cut_line(tmp_path)
    if not certificate:
        (tmp_path / "rollouts/right_box.certificate.json").unlink()
    again = open_ledger(tmp_path, library)
    assert again.num_passed == 0
    assert again.adopt(wall_s=9.0) == ["right_box"]
    assert again.num_passed == 1
    assert read_lines(tmp_path / CONVERSIONS) == [{**line, "wall_s": 9.0}]
    assert (tmp_path / "rollouts/right_box.certificate.json").is_file()
    stored = Rollout.load(tmp_path / line["rollout"])
    assert (stored.qpos == passing.qpos).all()
    assert again.adopt(wall_s=10.0) == []
    assert open_ledger(tmp_path, library).adopt(wall_s=10.0) == []


def test_a_later_pass_without_a_line_is_adopted(
    tmp_path, library, passing, monkeypatch
):
    def refuse(*args, **options):
        raise RunError("it cannot be certified today")

    ledger = open_ledger(tmp_path, library)
    passing.env_steps = 70
    with monkeypatch.context() as patch:
        patch.setattr("flashdex.rollouts.ledger.certify", refuse)
        ledger.record(passing, wall_s=2.0)
    assert not ledger.conversions["right_box"]["certified"]
    passing.env_steps = 90
    ledger.record(passing, wall_s=3.0)
    cut_line(tmp_path)
    again = open_ledger(tmp_path, library)
    assert again.adopt(wall_s=4.0) == ["right_box"]
    lines = read_lines(tmp_path / CONVERSIONS)
    assert [(x["env_steps"], x["wall_s"]) for x in lines] == [(70, 2.0), (90, 4.0)]
    assert again.conversions["right_box"]["env_steps"] == 70


def test_a_rollout_that_does_not_pass_is_not_adopted(tmp_path, library, passing):
    open_ledger(tmp_path, library).record(passing, wall_s=2.0)
    cut_line(tmp_path)
    passing.object_pos[20:, :, 0] += 0.5
    passing.save(tmp_path / "rollouts/right_box.npz")
    again = open_ledger(tmp_path, library)
    assert again.adopt(wall_s=9.0) == []
    assert read_lines(tmp_path / CONVERSIONS) == []


@pytest.mark.parametrize("dropped", [True, False])
def test_ctrl_c_is_not_lost_in_a_library_that_drops_it(dropped):
    reached = []

    @interruptible()
    def load():
        # as a callback from C does
        with suppress(KeyboardInterrupt if dropped else ()):
            signal.raise_signal(signal.SIGINT)
        reached.append("the end of the block")

    with pytest.raises(KeyboardInterrupt):
        load()
    assert len(reached) == dropped
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_motions_are_known_by_their_content(train_tiny, library, monkeypatch):
    contents = {name: f"hash of {name}" for name in library.names}
    monkeypatch.setattr(
        MotionLibrary,
        "motion_hash",
        lambda self, row: contents[self.names[row]],
        raising=False,
    )
    run_dir = train_tiny(seed=5)  # trained now, under these hashes
    assert read_object(run_dir, MOTIONS) == {"motions": contents}
    resume(run_dir, ["total_env_steps=366"])
    contents["both"] = "another motion of that name"
    kept = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    for use in (resume, evaluate):
        with pytest.raises(RunError, match="1 of 3 motions are not those"):
            use(run_dir)
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == kept
    evaluate(run_dir, [f"motions.library={library.path}"])  # asked for by name
