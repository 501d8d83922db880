"""Replay, training and ceilings are measured on the real parts."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks import replay, search, train
from benchmarks.common import output, turns
from benchmarks.common.ceilings import gather_seconds, matmul_ceilings, seconds_each
from flashdex.errors import FlashdexError
from flashdex.system.jsonl import read_lines

CPU = torch.device("cpu")
SMALL = ["algo.batch_size=16", "algo.critic_width=8", "algo.actor_width=8"]


@pytest.fixture
def words(library):
    given = [f"motions.library={library.path}", "motions.count=null"]
    return [*given, "physics.num_threads=1", *SMALL]


@pytest.fixture
def replay_words(words, monkeypatch):
    """The collection of the tests instead of a prepared one."""
    monkeypatch.setattr(replay, "PUSH", 64)
    monkeypatch.setattr(replay, "SOURCE_WORLDS", 4)
    make = output.compose_bench

    def compose(args, **options):
        args.objects = None
        return make(args, **options)

    monkeypatch.setattr(output, "compose_bench", compose)
    return words


def test_replay_fills_the_ring_and_prints_a_line_for_each_size(
    replay_words, capsys, tmp_path
):
    out = tmp_path / "folder" / "lines.jsonl"
    options = ["--rows", "500", "1k", "--seconds", "0.02", "--out", str(out)]
    found = replay.main([*options, *replay_words])
    printed = capsys.readouterr().out.splitlines()
    assert [json.loads(line) for line in printed] == found
    assert read_lines(out) == found
    assert [line["rows"] for line in found] == [500, 1000]
    for line in found:
        assert line["stored_bytes_per_row"] == line["bytes_per_row"] <= 1000
        assert line["gb"] * 1e9 == pytest.approx(990 * line["rows"], rel=0.01, abs=1e6)
        # drawing is part of what the loss reads
        assert line["sampled_rows_per_s"] > line["assembled_rows_per_s"] > 0
        assert line["ceiling_rows_per_s"] > 0
        assert line["hardware"]["torch"] == torch.__version__


def test_rows_that_do_not_fit_are_refused_before_they_are_made(replay_words):
    with pytest.raises(FlashdexError, match=r"10000000000 rows of 990 bytes are 99"):
        replay.main(["--rows", "10000M", "--seconds", "0.02", *replay_words])


def test_a_ring_smaller_than_one_write_is_refused(replay_words, monkeypatch):
    monkeypatch.setattr(replay, "PUSH", 1001)
    with pytest.raises(FlashdexError, match=r"--rows 1000 is less than the 1001"):
        replay.main(["--rows", "1k", "--seconds", "0.02", *replay_words])


@pytest.mark.parametrize(
    ("text", "count"), [("50M", 50_000_000), ("1.5k", 1500), ("7", 7)]
)
def test_counts_are_read(text, count):
    assert replay.count_of(text) == count


def test_train_measures_loop_and_ceilings(words, capsys):
    options = ["--num-envs", "8", "--seconds", "0.3", "--ceiling-seconds", "0.05"]
    found = train.main([*options, *words])
    assert json.loads(capsys.readouterr().out) == found
    steps = found["env_steps_per_s"] * found["seconds"]
    assert steps == pytest.approx(8 * found["vector_steps"], rel=0.02)
    updates = found["updates_per_s"] * found["seconds"]
    expected = found["updates_per_step"] * found["vector_steps"]
    assert updates == pytest.approx(expected, abs=found["updates_per_step"])
    assert set(found["ms_by_phase"]) >= {"act", "env", "update", "remember", "reset"}
    assert 0 < found["share_of_physics"] < 1
    physics = found["ceiling_physics_env_steps_per_s"]
    ratio = found["env_steps_per_s"] / physics
    assert found["share_of_physics"] == pytest.approx(ratio, abs=1e-3)
    assert found["rows"] > 0
    assert found["overflow"] == {}


def test_turns_begin_with_the_same_states_and_end_with_the_same(make_env):
    env = make_env(3, evaluation=True, finger_mode="residual")
    env.forced_motion = torch.arange(3)
    both = turns.Turns(env, steps=6)  # no motion ends: no world is reset
    draw = env.generator.get_state()
    targets, spent = both.loop()
    after = env.physics.raw().qpos.clone()
    env.generator.set_state(draw)
    alone = both.replay(targets)
    assert torch.equal(env.physics.raw().qpos, after)
    assert spent > 0
    assert alone > 0
    assert len(targets) == 6


def test_turns_give_rates_and_their_ratio(make_env):
    found = turns.measure(turns.Turns(make_env(4), steps=3), seconds=0.1)
    assert found["segments"] >= 3
    assert 0 < found["env_steps_per_s"] < found["physics_env_steps_per_s"]
    assert turns.physics_rate(make_env(4), seconds=0.05, steps=3) > 0
    assert turns.room_used(make_env(2)) == {}


def test_a_call_is_timed_over_as_many_as_fit():
    calls = []
    each = seconds_each(lambda: calls.append(1), seconds=0.02)
    assert 0 < each < 0.02
    assert len(calls) > 10
    # one call that is longer than the time is still measured, after the first
    calls.clear()
    seconds_each(lambda: calls.append(1), seconds=0.0)
    assert len(calls) == 2


def test_ceilings_are_of_the_stated_work():
    rates = matmul_ceilings(CPU, seconds=0.01)
    assert set(rates) == {"float32", "bfloat16"}
    assert rates["float32"] > 0.1
    options = {"kept_on": CPU, "device": CPU, "seconds": 0.05}
    few = gather_seconds(20_000, 800, 16, **options)
    many = gather_seconds(20_000, 800, 16_000, **options)
    assert many > 10 * few


def test_a_round_of_the_search_is_timed_beside_mujoco_c(library, capsys):
    words = ["--samples", "4", "--worlds", "2", "--horizon", "3", "--seconds", "0.01"]
    found = search.main([*words, f"motions.library={library.path}"])
    assert json.loads(capsys.readouterr().out) == found
    assert (found["engine"], found["horizon"]) == ("cpu", 3)
    assert found["gap_mm"] == 0
    assert found["samples_per_s"] < found["rollout_samples_per_s"]
    assert found["ratio"] > 0
    assert set(found["ms_by_part"]) == {"controls", "rollout", "cost"}
    assert found["overflow"] == {}
