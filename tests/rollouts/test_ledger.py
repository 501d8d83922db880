"""The ledger: one line an attempt, conversions that survive a crash."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
import torch

from flashdex.errors import RunError
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.ledger import CONVERSIONS, Ledger
from flashdex.rollouts.rollout import Rollout
from flashdex.system.jsonl import read_lines, write_lines

REQUIRED = {
    "motion": str,
    "converted": bool,
    "criterion": str,
    "errors": dict,
    "env_steps": int,
    "wall_s": float,
    "seed": int,
    "engine": str,
    "completed": bool,
    "why": list,
    "frame": int,
}


@pytest.fixture(scope="module")
def attempts(roll_tiny):
    """Zero residual actions: three attempts of full length."""

    def idle(td, env):
        return torch.zeros(env.num_envs, 2, 18)

    return roll_tiny(idle)


@pytest.fixture
def passing(attempts):
    """An attempt whose objects are written onto the reference, so that it passes."""
    rollout = copy.deepcopy(attempts[0])
    rollout.object_pos = rollout.ref_object_pos.copy()
    rollout.object_quat = rollout.ref_object_quat.copy()
    return rollout


@pytest.fixture
def failing(attempts):
    """An attempt whose object is half a metre off from frame 20 on."""
    rollout = copy.deepcopy(attempts[1])
    rollout.object_pos = rollout.ref_object_pos.copy()
    rollout.object_pos[20:, :, 0] += 0.5
    return rollout


def open_ledger(folder, library, **changes):
    settings = {"criterion": "sr_mt_obj", "seed": 3, "engine": "cpu", "certify": False}
    return Ledger(folder, library.names, **{**settings, **changes})


def record(ledger, rollout, *, env_steps, wall_s):
    """Record a rollout as one made at these env steps; is it the first pass?"""
    rollout.env_steps = env_steps
    line, is_first = ledger.record(rollout, wall_s=wall_s)
    assert line == read_lines(ledger.path)[-1]
    return is_first


def test_one_json_line_an_attempt(tmp_path, library, attempts, failing):
    ledger = open_ledger(tmp_path, library)
    for i, attempt in enumerate([*attempts, failing]):
        record(ledger, attempt, env_steps=100 * i, wall_s=1.5 * i)
    lines = [json.loads(x) for x in (tmp_path / CONVERSIONS).read_text().splitlines()]
    assert len(lines) == 4
    for line in lines:
        for key, kind in REQUIRED.items():
            assert isinstance(line[key], kind), key
        assert line["certified"] is None
        assert set(line["errors"]) == {"object_pos", "object_rot"}
        assert (line["criterion"], line["seed"]) == ("sr_mt_obj", 3)
    assert [x["env_steps"] for x in lines] == [0, 100, 200, 300]
    assert ledger.attempts == {"right_box": 1, "left_ball": 2, "both": 1}


def test_a_failed_attempt_says_why(tmp_path, library, failing):
    ledger = open_ledger(tmp_path, library)
    assert not record(ledger, failing, env_steps=5, wall_s=0.1)
    line = read_lines(tmp_path / CONVERSIONS)[0]
    assert not line["converted"]
    cause = line["why"][0]
    assert (cause["cause"], cause["hand"], cause["frame"]) == ("object_pos", "left", 20)
    errors = failing.object_pos[15:, 0] - failing.ref_object_pos[15:, 0]
    mean = np.linalg.norm(errors, axis=-1).mean()
    assert line["errors"]["object_pos"] == pytest.approx(mean, abs=1e-5)
    assert not list((tmp_path / "rollouts").iterdir())


def test_an_attempt_that_was_ended_names_the_termination(tmp_path, library, failing):
    failing.terminations = [{"cause": "object_dropped", "hand": "left"}]
    ledger = open_ledger(tmp_path, library)
    record(ledger, failing, env_steps=5, wall_s=0.1)
    line = read_lines(tmp_path / CONVERSIONS)[0]
    assert line["why"] == [{"cause": "object_dropped", "hand": "left"}]
    assert line["completed"] is False


def test_only_the_first_pass_is_a_conversion(tmp_path, library, passing):
    ledger = open_ledger(tmp_path, library)
    assert record(ledger, passing, env_steps=10, wall_s=2.0)
    first = ledger.conversions["right_box"]
    assert (first["env_steps"], first["certified"]) == (10, None)
    assert not record(ledger, passing, env_steps=20, wall_s=3.0)
    assert ledger.num_converted == 1
    lines = read_lines(tmp_path / CONVERSIONS)
    assert [x["converted"] for x in lines] == [True, True]
    stored = Rollout.load(tmp_path / lines[0]["rollout"])
    assert (stored.qpos == passing.qpos).all()
    assert json.loads(stored.errors) == lines[0]["errors"]
    metrics = ledger.metrics(2.0)
    assert metrics["convert/cumulative"] == 1
    assert metrics["convert/rate"] == pytest.approx(1 / 3)
    assert metrics["convert/attempts"] == 2
    assert metrics["convert/per_hour"] == 0.5


def test_the_stored_verdict_is_that_of_a_fresh_certificate(tmp_path, library, passing):
    ledger = open_ledger(tmp_path, library, certify=True)
    assert record(ledger, passing, env_steps=10, wall_s=2.0)
    conversion = ledger.conversions["right_box"]
    line = read_lines(tmp_path / CONVERSIONS)[0]
    fresh = certify(Rollout.load(tmp_path / line["rollout"]))
    assert line["verdict"] == fresh.verdict
    assert line["certified"] == conversion["certified"]
    assert line["certified"] == (fresh.verdict in ("certified", "robust"))
    stored = json.loads((tmp_path / "rollouts/right_box.certificate.json").read_text())
    assert stored == json.loads(fresh.to_json())
    assert ledger.num_certified == int(line["certified"])


@pytest.mark.parametrize("cut", [1, 40])
def test_a_cut_off_last_line_costs_that_line_only(
    tmp_path, library, passing, failing, cut
):
    ledger = open_ledger(tmp_path, library)
    record(ledger, passing, env_steps=10, wall_s=2.0)
    record(ledger, failing, env_steps=20, wall_s=2.5)
    path = tmp_path / CONVERSIONS
    path.write_text(path.read_text()[:-cut])
    again = open_ledger(tmp_path, library)
    assert list(again.conversions) == ["right_box"]
    assert again.conversions["right_box"]["env_steps"] == 10
    assert again.attempts["right_box"] == 1
    # what is written next must be readable, too
    record(again, failing, env_steps=30, wall_s=3.0)
    lines = read_lines(path)
    assert lines[-1]["env_steps"] == 30
    assert open_ledger(tmp_path, library).attempts["left_ball"] == 1
    assert list(open_ledger(tmp_path, library).conversions) == ["right_box"]


def test_a_broken_line_in_the_middle_is_an_error(tmp_path):
    path = tmp_path / "x.jsonl"
    path.write_text('{"a": 1}\n{"b":\n{"c": 2}\n')
    with pytest.raises(RunError, match="line 2 is not JSON"):
        read_lines(path)


def test_lines_of_another_criterion_or_motion_do_not_count(tmp_path, library, passing):
    record(open_ledger(tmp_path, library), passing, env_steps=10, wall_s=2.0)
    strict = open_ledger(tmp_path, library, criterion="sr_mt_obj_x0.5")
    assert strict.num_converted == 0
    lines = read_lines(tmp_path / CONVERSIONS)
    write_lines(tmp_path / CONVERSIONS, [x | {"motion": "left_out"} for x in lines])
    assert open_ledger(tmp_path, library).num_converted == 0


def test_a_later_pass_may_prove_what_the_first_could_not(tmp_path, library, passing):
    unproven = copy.deepcopy(passing)  # its objects are moved: the certificate fails
    ledger = open_ledger(tmp_path, library, certify=True)
    assert record(ledger, unproven, env_steps=10, wall_s=2.0)
    first = ledger.conversions[unproven.motion]
    assert not first["certified"]
    assert not record(ledger, unproven, env_steps=20, wall_s=3.0)
    lines = read_lines(tmp_path / CONVERSIONS)
    assert [bool(x.get("rollout")) for x in lines] == [True, True]
    assert first["env_steps"] == 10
    assert ledger.metrics(1.0)["convert/robust"] == 0
