"""Runs of the search: conversions that verify, and nothing done twice or lost."""

import dataclasses
import os
import shutil
import signal
import sys
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from subprocess import PIPE, Popen

import pytest
from synthetic import FRIENDLY

from flashdex.cli.main import main
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.errors import FlashdexError
from flashdex.recipe import (
    LoggerConfig,
    MotionsConfig,
    SearchRecipe,
    dump_recipe,
    validate,
)
from flashdex.reports.run.terminal import run_table
from flashdex.rollouts.ledger import CONVERSIONS, read_ledger
from flashdex.search.config import Rung, SearchConfig
from flashdex.system.children import PYTHON
from flashdex.system.jsonl import read_object, write_object
from flashdex.system.run_files import read_metrics, read_sessions
from flashdex.training.loaded import verify
from flashdex.training.run_dir import load_run_recipe, train
from flashdex.training.tasks import planning
from flashdex.training.tasks import search as searching
from flashdex.training.tasks.search import resume_search, search

CHEAP = Rung(samples=6, rounds=1, horizon=12)
LADDERS = SearchConfig(workers=1, ladder=[CHEAP], robust_ladder=[CHEAP])


@pytest.fixture
def recipe(library, tmp_path):
    return validate(
        SearchRecipe(
            name="tiny",
            total_env_steps=10**6,
            run_dir=str(tmp_path / "run"),
            motions=MotionsConfig(library=str(library.path)),
            physics=PhysicsConfig(num_threads=1, **FRIENDLY),
            search=LADDERS,
            logger=LoggerConfig(),
        )
    )


def only(recipe, *names):
    motions = dataclasses.replace(recipe.motions, select=list(names))
    return dataclasses.replace(recipe, motions=motions)


@pytest.fixture
def inline(monkeypatch):
    """Work in this process: a worker of its own takes seconds to begin."""
    from concurrent.futures import Future

    class Pool:
        _processes = None

        def __init__(self, count, begin, *given):
            planning._worker[:] = [planning.Worker(*given)]

        def submit(self, work, order):
            future = Future()
            future.set_result(work(order))
            return future

        def shutdown(self, **kwargs):
            planning._worker.clear()

    monkeypatch.setattr(searching, "spawning_pool", Pool)


def test_a_search_leaves_a_run_that_verifies(recipe, inline):
    run = search(recipe)
    lines = read_ledger(run / CONVERSIONS)
    assert {line["motion"] for line in lines} == {"right_box", "left_ball", "both"}
    assert {line["source"] for line in lines} == {"search"}
    assert any(line["certified"] for line in lines)
    assert all(line["attempt_s"] > 0 for line in lines)
    steps = [line["env_steps"] for line in lines]
    assert steps == sorted(set(steps))
    found = verify(run)
    assert found.holds, found.findings
    last = read_metrics(run)[-1]
    assert last["search/core_s"] == pytest.approx(sum(x["attempt_s"] for x in lines))
    assert last["search/core_s"] == pytest.approx(lines[-1]["core_s"], abs=1e-2)
    assert last["convert/attempts"] == len(lines)


def test_a_search_goes_on_where_it_stopped(recipe, inline, monkeypatch):
    """What a killed run has in its ledger is not done again; the end is the same."""
    recipe = only(recipe, "right_box", "left_ball")
    whole = search(dataclasses.replace(recipe, run_dir=recipe.run_dir + "-whole"))
    wanted = [
        (x["motion"], x["rung"], x["errors"]) for x in read_ledger(whole / CONVERSIONS)
    ]
    take = searching._Session._take
    taken = []

    def dying(self, found, progress):
        if len(taken) == 1:
            raise KeyboardInterrupt
        taken.append(found.order)
        take(self, found, progress)

    monkeypatch.setattr(searching._Session, "_take", dying)
    with pytest.raises(KeyboardInterrupt):
        search(recipe)
    monkeypatch.setattr(searching._Session, "_take", take)
    run = resume_search(recipe.run_dir)
    found = [
        (x["motion"], x["rung"], x["errors"]) for x in read_ledger(run / CONVERSIONS)
    ]
    assert sorted(found, key=str) == sorted(wanted, key=str)
    assert verify(run).holds
    assert resume_search(run) == run  # nothing is left
    assert len(read_ledger(run / CONVERSIONS)) == len(found)
    assert read_sessions(run)[-1]["why"] == "nothing left to try"


def test_a_search_is_no_run_to_train_on(recipe, inline, capsys):
    with pytest.raises(FlashdexError, match="flashdex search"):
        train(recipe)
    spent = dataclasses.replace(LADDERS, budget_s=1e-6)
    run = search(dataclasses.replace(only(recipe, "right_box"), search=spent))
    assert main(["train", "--resume", str(run)]) == 2
    assert "flashdex search" in capsys.readouterr().err


def test_a_run_of_a_policy_is_no_search_to_go_on(converted_run):
    with pytest.raises(FlashdexError, match="task: search"):
        resume_search(converted_run)


def test_workers_search_in_processes_of_their_own(recipe):
    ladders = dataclasses.replace(LADDERS, robust_ladder=[])
    run = search(dataclasses.replace(only(recipe, "right_box"), search=ladders))
    (line,) = read_ledger(run / CONVERSIONS)
    assert line["motion"] == "right_box"
    assert verify(run).holds


def test_the_command_composes_a_recipe_for_the_search(capsys):
    words = ["search", "quickstart", "search.ladder=[]", "physics=brax"]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "search.ladder: empty" in told
    assert "physics.engine" in told
    assert main(["search", "quickstart", "physics=warp", "search.workers=2"]) == 2
    assert "search.workers" in capsys.readouterr().err
    assert main(["train", "quickstart", "search.stride=4"]) == 2
    assert "task: search" in capsys.readouterr().err


@pytest.fixture
def left(recipe, inline, monkeypatch):
    """A search by playback alone: one motion is done, two come near."""
    from flashdex.rollouts import ledger

    # objects of these motions hardly move, and such passes are not the last word
    monkeypatch.setattr(ledger, "stays_behind", lambda errors: False)
    playback = dataclasses.replace(LADDERS, ladder=[Rung(samples=2, horizon=12)])
    train = dataclasses.replace(recipe.train, criterion="sr_mt_obj_x0.5", certify=False)
    found = dataclasses.replace(recipe, search=playback, train=train)
    run = search(found)
    told = {x["motion"]: bool(x.get("miss")) for x in read_ledger(run / CONVERSIONS)}
    assert told == {"right_box": False, "left_ball": True, "both": True}
    return run, dataclasses.replace(
        found, search=LADDERS, run_dir=recipe.run_dir + "-more"
    )


def test_a_search_goes_on_from_what_a_run_left(left, monkeypatch):
    """Its run may be deleted; the misses come first, each from where it was."""
    source, recipe = left
    misses = {path.stem: path.read_bytes() for path in (source / "misses").iterdir()}
    asked = []
    make = planning.Planner

    def planner(problem, *given, start, **more):
        asked.append((problem.row, start))
        return make(problem, *given, start=start, **more)

    monkeypatch.setattr(planning, "Planner", planner)
    take = searching._Session._take

    def dying(self, found, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(searching._Session, "_take", dying)
    with pytest.raises(KeyboardInterrupt):
        search(recipe, source=source)
    monkeypatch.setattr(searching._Session, "_take", take)
    shutil.rmtree(source)
    run = resume_search(recipe.run_dir)
    lines = read_ledger(run / CONVERSIONS)
    assert {x["motion"] for x in lines} == {"left_ball", "both"}
    begun = {x["motion"]: x["start"] for x in lines if x["rung"] == 0 and "start" in x}
    assert begun == {n: sha256(data).hexdigest() for n, data in misses.items()}
    started = [start for _, start in asked if start is not None]
    assert len(started) == len(begun) + 1  # one of them was lost with the kill
    assert all(0 < len(start) <= 51 for start in started)
    assert "1 more converted by the run" in run_table(run)
    assert resume_search(run) == run
    assert len(read_ledger(run / CONVERSIONS)) == len(lines)
    source_file = run / "starts/both.npz"
    source_file.write_bytes(source_file.read_bytes()[:-1])
    assert main(["search", "--resume", str(run)]) == 2


def test_a_run_of_other_things_is_no_source(left, capsys):
    source, recipe = left
    physics = dataclasses.replace(recipe.physics, object_friction=0.5, iterations=7)
    other = dataclasses.replace(recipe, physics=physics)
    with pytest.raises(FlashdexError, match=r"object_friction is 2\.0, expected 0\.5"):
        search(other, source=source)
    train = dataclasses.replace(recipe.train, criterion="sr_mt")
    with pytest.raises(FlashdexError, match=r"its train\.criterion is sr_mt_obj_x0\.5"):
        search(dataclasses.replace(recipe, train=train), source=source)
    known = read_object(source, "motions.json")["motions"]
    write_object({"motions": known | {"both": "0" * 64}}, source, "motions.json")
    with pytest.raises(FlashdexError, match="another content of 1 motions, 'both'"):
        search(recipe, source=source)
    assert not Path(recipe.run_dir).exists()


@pytest.mark.slow
def test_samples_of_warp_become_conversions_of_mujoco_c(recipe, inline):
    """The same controls give the stored states on the cpu engine; a resume goes on."""
    pytest.importorskip("mujoco_warp")
    few = dataclasses.replace(LADDERS, samples_factor=1, robust_ladder=[], workers=0)
    recipe = dataclasses.replace(
        only(recipe, "right_box"),
        physics=PhysicsConfig(engine="warp", num_threads=1, **FRIENDLY),
        search=few,
    )
    run = search(recipe)
    (line,) = read_ledger(run / CONVERSIONS)
    assert line["engine"] == "cpu"
    assert line["certified"]
    kept = load_run_recipe(run)
    assert (kept.physics.engine, kept.search.engine) == ("cpu", "warp")
    assert verify(run).holds
    assert resume_search(run) == run
    assert len(read_ledger(run / CONVERSIONS)) == 1


def test_warp_that_is_not_installed_is_said_before_anything_is_written(
    recipe, monkeypatch
):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    config = dataclasses.replace(LADDERS, engine="warp")
    with pytest.raises(FlashdexError, match="'warp'"):
        search(dataclasses.replace(recipe, search=config))
    assert not Path(recipe.run_dir).exists()


def workers_of(pid):
    """Processes of the pool of a search."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [n for n in map(int, children) if "spawn_main" in command_of(n)]


def command_of(pid):
    """Empty for a process that has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


def wait_until(is_true):
    end = time.monotonic() + 120
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
@pytest.mark.parametrize("victim", ["search", "worker"])
def test_a_search_that_is_killed_goes_on(recipe, tmp_path, inline, victim):
    found = dataclasses.replace(LADDERS, workers=2, ladder=[CHEAP, CHEAP])
    recipe = dataclasses.replace(only(recipe, "left_ball", "both"), search=found)
    file, run = tmp_path / "tiny.yaml", Path(recipe.run_dir)
    file.write_text(dump_recipe(recipe))
    command = [*PYTHON, "-m", "flashdex.cli", "search", str(file)]
    with Popen(command, stderr=PIPE, text=True) as process:
        lines = run / CONVERSIONS
        wait_until(lambda: lines.exists() and lines.read_bytes().count(b"\n"))
        workers = workers_of(process.pid)
        assert len(workers) == 2
        os.kill(process.pid if victim == "search" else workers[0], signal.SIGKILL)
        _, told = process.communicate(timeout=120)
    wait_until(lambda: not any(map(command_of, workers)))
    assert process.returncode == (-signal.SIGKILL if victim == "search" else 2)
    assert victim == "search" or "a process of the search has died" in told
    before = read_ledger(lines)
    assert 0 < len(before) < 4
    resume_search(run)
    after = read_ledger(lines)
    assert after[: len(before)] == before
    every = [(x["motion"], x["rung"]) for x in after]
    assert sorted(every) == [(m, r) for m in ("both", "left_ball") for r in (0, 1)]
    assert verify(run).holds
