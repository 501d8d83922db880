"""The benchmark compares like with like."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks import env as bench
from benchmarks.common import turns


def test_bare_physics_follows_the_environment_bit_for_bit(make_env):
    env = make_env(3, evaluation=True, finger_mode="residual")
    env.forced_motion = torch.arange(3)
    both = turns.BareTurns(env, num_threads=1)
    for _ in range(2):  # 20 steps: no motion has ended, so no world was reset
        turn = both.run()
        assert turn.env > 0
        assert turn.physics > 0
        assert (both.bare.bind("qpos") == env.physics.batch.bind("qpos")).all()
        assert (
            both.bare.bind("sensordata") == env.physics.batch.bind("sensordata")
        ).all()


def test_measure_gives_rates_and_their_ratio(make_env):
    out = turns.measure(turns.BareTurns(make_env(4), num_threads=1), seconds=0.1)
    assert out["segments"] >= 3
    rates = out["env_steps_per_s"], out["physics_env_steps_per_s"]
    assert 0 < rates[0] < rates[1]
    assert out["ratio"] == pytest.approx(rates[0] / rates[1], rel=0.5)


def test_main_prints_one_json_object(library, capsys):
    words = ["--num-envs", "3", "--seconds", "0.1", f"motions.library={library.path}"]
    out = bench.main([*words, "physics.num_threads=1", "motions.count=null"])
    printed = capsys.readouterr().out
    assert json.loads(printed) == out
    assert printed.count("\n") == 1
    wanted = {"benchmark", "hardware", "commit", "env_steps_per_s", "ratio", "num_envs"}
    wanted |= {"physics_env_steps_per_s", "decimation", "torch_threads"}
    assert wanted <= out.keys()
    assert (out["num_envs"], out["decimation"]) == (3, 4)


def test_threads_are_limited_and_given_back():
    from flashdex.envs.tracking import few_threads

    before = torch.get_num_threads()
    for worlds, limit in ((1, 1), (1500, 1), (4096, 4)):
        with few_threads(worlds):
            assert torch.get_num_threads() == min(before, limit)
        assert torch.get_num_threads() == before
    with pytest.raises(RuntimeError), few_threads(1):
        raise RuntimeError
    assert torch.get_num_threads() == before
