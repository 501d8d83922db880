"""`flashdex doctor RECIPE`: memory of a recipe, in the terminal and on the page."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest

from flashdex.cli import doctor
from flashdex.cli.main import main
from flashdex.system.machine import Machine
from flashdex.training.memory import plan as memory

PAGE = Path(__file__).parents[2] / "docs" / "memory.md"
PACKAGE = Path(__file__).parents[2] / "flashdex"
GB = 10**9


@pytest.fixture
def give(monkeypatch):
    """Pretend that this machine has so many free bytes."""

    def set_free(*, gpu=None, host=100 * GB, disk=100 * GB):
        found = Machine(gpu, host, disk)
        monkeypatch.setattr(memory, "look_at_machine", lambda _: found)

    return set_free


def test_a_recipe_that_fits(give, capsys):
    give()
    assert main(["doctor", "quickstart"]) == 0
    out = capsys.readouterr().out
    assert "host memory:" in out
    assert "It fits." in out
    assert "GFLOP" in out
    assert "by card" not in out  # this learner is on the host


def test_a_recipe_that_does_not(give, capsys):
    give(host=30 * GB)
    assert main(["doctor", "quickstart", "algo.buffer_size=40_000_000"]) == 1
    out = capsys.readouterr().out
    assert "It does not fit: host memory " in out
    offered = re.findall(r"^  (algo\.buffer_size=\d+)$", out, re.MULTILINE)
    assert len(offered) == 1
    assert main(["doctor", "quickstart", *offered]) == 0


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["gym_halfcheetah"], "needs a recipe with task: retarget"),
        (["quickstrat"], "Did you mean 'quickstart'?"),
        (["quickstart", "algo.bufer_size=3"], "Did you mean 'buffer_size'?"),
    ],
)
def test_mistakes_exit_two(argv, expected, capsys):
    assert main(["doctor", *argv]) == 2
    assert expected in capsys.readouterr().err


def test_ppo_has_a_rollout_and_no_rows(give):
    give()
    report, fits = doctor.examine_recipe("quickstart", ["algo=ppo"])
    assert fits
    assert "rollout" in report
    assert "replay rows" not in report


def test_the_page_shows_what_is_printed(give):
    pytest.importorskip("mujoco_warp")
    give()
    report, fits = doctor.examine_recipe(
        "bench50_xhand", ["motions.library=/nowhere/bench50"]
    )
    assert not fits  # no GPU
    page = PAGE.read_text()
    # what other parts of the house decide is left out: physics, and sums with it
    names = ("replay rows", "update", "networks", "observations", "checkpoints")
    lines = [s for s in report.splitlines() if s.strip().startswith(names)]
    assert len(lines) == len(names)
    for line in [*lines, next(s for s in report.splitlines() if "GFLOP" in s)]:
        assert line in page


def test_a_missing_package_is_an_answer(give, capsys, monkeypatch):
    """Exit code 1, as the page says: something is missing, nothing is mistaken."""
    give()
    for name in ("mujoco_warp", "warp"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["doctor", "quickstart", "physics=warp"]) == 1
    assert "pip install '.[warp]'" in capsys.readouterr().out


def test_only_extras_that_code_uses_are_advertised():
    project = tomllib.loads((PAGE.parents[1] / "pyproject.toml").read_text())["project"]
    code = "\n".join(p.read_text() for p in PACKAGE.rglob("*.py"))
    used = set(re.findall(r', extra="(\w+)"\)', code))
    assert set(project["optional-dependencies"]) == used | {"dev"}


def test_licence_and_notice_go_into_the_wheel():
    project = tomllib.loads((PAGE.parents[1] / "pyproject.toml").read_text())["project"]
    for name in ("LICENSE", "NOTICE"):
        assert name in project["license-files"]
        assert (PAGE.parents[1] / name).is_file()
