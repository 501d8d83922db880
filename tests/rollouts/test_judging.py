"""Scorer in a process beside the loop: the same lines, and no silent death."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from flashdex import keys
from flashdex.errors import RunError
from flashdex.recipe import MotionsConfig
from flashdex.rollouts.ledger import CONVERSIONS, Ledger
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.rollouts.scorer import InlineScorer, ProcessScorer, ScorerSpec
from flashdex.system.jsonl import read_lines
from flashdex.system.machine import versions
from flashdex.training.tasks.tracking import make_inline_scorer


def die(spec):
    os._exit(7)


def cannot_write(spec):
    raise OSError(28, "No space left on device")


@pytest.fixture
def bench(make_bench, library):
    bench = make_bench(6, attempt_share=1.0, finger_mode="residual")
    motions = MotionsConfig(library=str(library.path))
    recipe = dataclasses.replace(bench.recipe, motions=motions)
    return dataclasses.replace(bench, recipe=recipe)


@pytest.fixture
def episodes(bench):
    """Finished episodes of shaky hands, and the scenes they took place in."""
    env = bench.make_env()
    recorder, found = EpisodeRecorder(env), []
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    recorder.record_start()
    for step in range(90):
        action = 0.4 * (2 * torch.rand(6, 2, 18, generator=generator) - 1)
        env.put_action(td, action)
        done = env.step(td)["next", keys.DONE]
        found += recorder.record_step(action, done, step)
        td = env.reset_worlds(done.squeeze(-1))
        recorder.record_start()
    assert len(found) > 6
    return found, env.physics.scenes


def make_ledger(bench, folder):
    recipe = bench.recipe
    return Ledger(
        folder,
        bench.bank.names,
        criterion=recipe.train.criterion,
        seed=recipe.seed,
        engine="cpu",
    )


def beside(bench, folder, make=make_inline_scorer):
    spec = ScorerSpec(bench.recipe, folder, versions(), {"date": "today"}, {})
    return ProcessScorer(make_ledger(bench, folder), spec, make)


def test_both_ways_write_the_same_lines(bench, episodes, tmp_path):
    found, scenes = episodes
    builder = bench.rollout_builder(
        scenes, made_by=versions(), provenance={"date": "today"}
    )
    here = InlineScorer(make_ledger(bench, tmp_path / "here"), builder)
    there = beside(bench, tmp_path / "there")
    conversions = [[], []]
    for number, episode in enumerate(found):
        for scorer, list_ in zip((here, there), conversions, strict=True):
            scorer.submit(episode, 0.5 * number)
            list_ += scorer.collect()
    conversions[1] += there.collect(wait=True)
    assert there.pending == 0
    there.close()
    lines = [read_lines(tmp_path / name / CONVERSIONS) for name in ("here", "there")]
    lines = [list(x) for x in lines]
    assert lines[0] == lines[1]
    assert len(lines[0]) == len(found)
    assert conversions[0] == conversions[1]
    assert here.ledger.metrics(1.0) == there.ledger.metrics(1.0)
    assert here.ledger.num_bytes == there.ledger.num_bytes


def test_a_process_that_dies_is_noticed(bench, episodes, tmp_path):
    scorer = beside(bench, tmp_path, die)
    scorer.submit(episodes[0][0], 1.0)
    with pytest.raises(RunError, match="died with 1 of them"):
        scorer.collect(wait=True)
    scorer.close(wait=False)


def test_an_error_of_the_process_is_that_of_the_loop(bench, episodes, tmp_path):
    scorer = beside(bench, tmp_path, cannot_write)
    scorer.submit(episodes[0][0], 1.0)
    with pytest.raises(OSError, match="No space left"):
        scorer.collect(wait=True)
    scorer.close(wait=False)


ENDS = """
import sys
from pathlib import Path
from types import SimpleNamespace
sys.path[:0] = {folders!r}
import numpy as np
from test_judging import cannot_write, die
from flashdex.rollouts.recorder import Episode
from flashdex.rollouts.scorer import ProcessScorer, ScorerSpec

if __name__ == "__main__":
    make = {{"die": die, "error": cannot_write, "backlog": die}}[sys.argv[1]]
    ledger = SimpleNamespace(path=Path('run') / 'lines')
    spec = ScorerSpec(None, None, {{}}, {{}}, {{}})
    scorer = ProcessScorer(ledger, spec, make)
    state = np.zeros(3)
    wide = {{"qpos": np.zeros((2000, 100))}}
    try:
        for _ in range(20):
            scorer.submit(Episode(0, 0, wide, state, state, 0, 0, {{}}), 0.0)
        if sys.argv[1] != "backlog":
            scorer.collect(wait=True)
    except Exception as error:
        print(type(error).__name__)
    scorer.close(wait=False)
    print("closed")
"""


@pytest.mark.parametrize(
    ("way", "said"), [("die", "RunError"), ("error", "OSError"), ("backlog", "")]
)
def test_the_interpreter_ends_with_episodes_in_line(tmp_path, way, said):
    script = tmp_path / "train.py"
    here = Path(__file__).parent
    script.write_text(ENDS.format(folders=[str(here), str(here.parent)]))
    done = subprocess.run(
        [sys.executable, script, way],
        cwd=here.parent.parent,
        env={**os.environ, "PYTHONPATH": str(here.parent.parent)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    assert "closed" in done.stdout


def test_a_run_judged_beside_the_loop_begins_alike(start_tiny, tmp_path):
    runs = {}
    for way in ("inline", "process"):
        start_tiny(tmp_path / way, train={"judge": way})
        lines = read_lines(tmp_path / way / CONVERSIONS)
        # of the files: they hold the time and the folder of the run
        own = ("wall_s", "rollout_sha256", "certificate_sha256")
        runs[way] = [{k: v for k, v in x.items() if k not in own} for x in lines]
    # What converts is drawn less often, a little later when the verdict comes later.
    first = [x["converted"] for x in runs["inline"]].index(True) + 1
    assert runs["inline"][:first] == runs["process"][:first]
    assert all(
        (tmp_path / "process" / x["rollout"]).is_file()
        for x in runs["process"]
        if x.get("rollout")
    )
