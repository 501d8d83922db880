"""Every example runs, and says what its page promises."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
SAID = {
    "01_env": "random, right: mean reward",
    "02_train_with_torchrl": "320 rows, critic's loss",
    "03_own_reward_and_observation": "steady_object",
    "04_rollout": "certificate: ",
    "05_ablation": "without surface_distance: ",
    "06_policy": "mean return",
}
NEEDS_RUN = ("04_rollout", "06_policy")


pytestmark = pytest.mark.usefixtures("forget_terms")


@pytest.fixture(scope="session")
def finished_run(start_tiny, tmp_path_factory):
    """A small run, with a rollout that every criterion would have passed or not."""
    folder = tmp_path_factory.mktemp("examples") / "run"
    return start_tiny(folder, train={"criterion": "sr_spider_raw"})


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES} == set(SAID)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, library, request, monkeypatch, capsys):
    words = [f"motions.library={library.path}", "physics.num_threads=1"]
    words += ["motions.count=null", "env.transforms.object_points.num_points=4"]
    if path.stem in NEEDS_RUN:
        run = request.getfixturevalue("finished_run")
        words = [str(run)]
    monkeypatch.setattr(sys, "argv", [str(path), *words])
    runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr().out
    assert SAID[path.stem] in printed
    if path.stem == "05_ablation":
        widths = [line.split(": ")[1] for line in printed.splitlines()[1:]]
        assert widths[0] != widths[1] == widths[2]
    if path.stem == "04_rollout":
        assert "the last state differs by 0" in printed
