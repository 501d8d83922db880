"""The crash test of benchmarks/, with few kills."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks/crash_test.py"


@pytest.mark.slow
def test_three_kills_lose_nothing(tmp_path):
    spec = importlib.util.spec_from_file_location("crash_test", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    found = script.run_test(
        tmp_path,
        kills=3,
        interval=1.0,
        seed=1,
        kinds=("storing", "saving", "training"),
        overrides=("train.log_every_s=0.2",),
        last_env_steps=800,
    )
    assert len(found["kills"]) == 3
    assert found["conversions"]
    assert found["rollouts_that_replay_as_stored"] == len(found["conversions"])
    assert found["env_steps_lost"] > 0
