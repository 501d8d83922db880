"""The rule that chooses a benchmark's motions."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import yaml

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture
def choose():
    path = BENCHMARKS / "choose_motions.py"
    spec = importlib.util.spec_from_file_location("choose_motions", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.choose


def row(name, depth, status="kept"):
    return {"motion": name, "status": status, "human_tip_depth_mm": str(depth)}


def scores(**passed):
    return {
        name: {m: {"passed": passed.get(name, {}).get(m, [])} for m in "abcde"}
        for name in ("do_nothing", "frozen_object", "kinematic_playback")
    }


def test_cleanest_motions_that_nothing_trivial_passes(choose):
    report = [
        row("e", 1),
        row("d", 3, "flagged"),
        row("c", 2),
        row("b", 0),
        row("a", 0),
    ]
    report.append(row("rejected", "", "rejected"))
    trivial = scores(
        do_nothing={"b": ["sr_loose"]},
        frozen_object={"c": ["sr_mt_obj"]},
        kinematic_playback={"e": ["sr_mt_obj"], "d": ["sr_loose"]},
    )
    assert choose(report, trivial, 1) == (["a"], 2)
    assert choose(report, trivial, 9) == (["a", "d"], 2)


def test_recipe_names_fifty_motions_of_the_set():
    recipe = yaml.safe_load((RECIPES / "myodm_xhand.yaml").read_text())
    names = recipe["motions"]["select"]
    assert len(names) == len(set(names)) == 50
    assert names == sorted(names)
