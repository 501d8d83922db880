"""What no learning achieves, on motions whose outcome is known."""

from __future__ import annotations

import dataclasses
import json
import os

import numpy as np
import pytest
import torch
from synthetic import write_library

from flashdex.cli.main import main
from flashdex.envs.scene.scene import build_scenes
from flashdex.errors import RunError
from flashdex.system.jsonl import read_object, write_object
from flashdex.training import baselines, build
from flashdex.training.baselines import (
    Baselines,
    format_baselines,
    score_baselines,
)
from flashdex.training.evaluator import roll_all


def test_table_counts_motions_by_criterion():
    rows = {
        "do_nothing": {"a": {"passed": ["sr_mt_obj"]}, "b": {"passed": []}},
        "frozen_object": {
            "a": {"passed": ["sr_mt_obj", "sr_mt_obj_left"]},
            "b": {"passed": ["sr_mt_obj"]},
        },
    }
    lines = format_baselines(Baselines(rows)).splitlines()
    assert lines[0].startswith("of 2 motions")
    assert lines[3].split() == ["criterion", "do_nothing", "frozen_object"]
    table = {line.split()[0]: line.split()[1:] for line in lines[4:]}
    assert table["sr_mt_obj"] == ["1", "2"]
    assert table["sr_mt"] == ["0", "0"]
    assert not any(name.endswith("_left") for name in table)


def test_command_scores_a_library(library, tmp_path, capsys):
    out = tmp_path / "scores.json"
    words = ["baselines", "quickstart", f"motions.library={library.path}"]
    hz = library.fps
    words += [f"physics.timestep={1 / hz / 4}", f"motions.control_hz={hz}"]
    words += ["motions.count=null", "--out", str(out)]
    assert main(words) == 0
    assert "kinematic_playback" in capsys.readouterr().out
    scores = read_object(tmp_path, out.name)
    assert set(scores) == {"do_nothing", "kinematic_playback", "frozen_object"}
    assert list(scores["do_nothing"]) == library.names


@pytest.mark.parametrize("kind", ["link", "pipe", "below_a_file"])
def test_out_is_a_file_of_its_own_or_refused(tmp_path, capsys, kind):
    kept, out = tmp_path / "kept", tmp_path / "out.json"
    kept.write_text("mine")
    if kind == "link":
        out.symlink_to(kept)
    elif kind == "pipe":
        os.mkfifo(out)
    else:
        out = kept / "out.json"
    assert main(["baselines", "quickstart", "--out", str(out)]) == 2
    assert f"--out: {out} cannot be written" in capsys.readouterr().err
    assert kept.read_text() == "mine"
    assert kind == "below_a_file" or os.path.lexists(out)
    assert kind != "pipe" or out.is_fifo()


def test_gym_recipe_has_no_baselines(capsys):
    assert main(["baselines", "gym_halfcheetah"]) == 2
    assert "gym" in capsys.readouterr().err


@pytest.fixture
def rolled(monkeypatch):
    """Rows that each call rolls, of the two baselines that are simulated.

    What is simulated is the same in all tests, and done once.
    """
    seen = []

    def roll(builder, controller, *, rows, target):
        names = [builder.bank.names[row] for row in rows]
        seen.append(names)
        for row, name in zip(rows, names, strict=True):
            if (target, name) not in ROLLED:
                whole = roll_all(builder, controller, rows=[row], target=target)
                ROLLED[target, name] = next(whole)
            yield ROLLED[target, name]

    monkeypatch.setattr(baselines, "roll_all", roll)
    return seen


ROLLED = {}


def test_a_session_pays_for_what_changed_only(make_bench, hands, tmp_path, rolled):
    bench, file = make_bench(), tmp_path / "baselines.json"
    rows = score_baselines(bench, file).rows
    names = bench.library.names
    assert rolled == [names] * 2
    assert score_baselines(make_bench(), file).rows == rows
    assert rolled[2:] == [[]] * 2

    def heavier(record):  # the same name, another object
        mass = 1.5 * record.objects[0].mass
        box = dataclasses.replace(record.objects[0], mass=mass, sha256="heavy")
        record.objects = [box, *record.objects[1:]]

    changes = {"right_box": [heavier]}
    other = write_library(tmp_path / "other", hands, changes=changes)
    builder = dataclasses.replace(make_bench(), library=other)
    score_baselines(builder, file)
    assert rolled[4:] == [["right_box"]] * 2


@pytest.mark.parametrize(
    ("fields", "is_paid"),
    [
        ({"algo": {"actor_width": 32}}, False),
        ({"num_envs": 3}, False),
        ({"rewards": {}}, False),
        ({"train": {"criterion": "sr_mt"}}, True),
        ({"feedforward": "lag"}, True),
        ({"max_seconds": 0.3}, True),
    ],
    ids=["network", "worlds", "rewards", "criterion", "feedforward", "length"],
)
def test_an_override_pays_for_baselines_that_it_changes(
    make_bench, tmp_path, rolled, fields, is_paid
):
    file = tmp_path / "baselines.json"
    score_baselines(make_bench(), file)
    score_baselines(make_bench(**fields), file)
    assert [bool(rows) for rows in rolled[2:]] == [is_paid] * 2


def edited(rows):
    rows["do_nothing"]["both"]["passed"] = ["sr_mt_obj"]
    return rows


def exchanged(rows):
    table = rows["do_nothing"]
    table["both"], table["left_ball"] = table["left_ball"], table["both"]
    return rows


SPOILT = {
    "edited": edited,
    "exchanged": exchanged,
    "cut": lambda rows: json.dumps(rows)[:-40],
    "list": lambda rows: "[]",
    "rows-list": lambda rows: {key: [1] for key in rows},
    "row-text": lambda rows: {k: dict.fromkeys(v, "a") for k, v in rows.items()},
    "empty": lambda rows: "",
    "deep": lambda rows: "[" * 100_000,
    "zeros": lambda rows: "\0" * 100,
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_file_is_scored_again(make_bench, tmp_path, rolled, case):
    file = tmp_path / "baselines.json"
    rows = score_baselines(make_bench(), file).rows
    spoilt = SPOILT[case](read_object(tmp_path, file.name))
    if isinstance(spoilt, dict):  # sealed, as somebody who knows the format would
        write_object(spoilt, tmp_path, file.name)
    else:
        file.write_text(spoilt)
    assert score_baselines(make_bench(), file).rows == rows
    assert read_object(tmp_path, file.name) == rows


def test_a_pipe_in_its_place_is_not_waited_for(make_bench, tmp_path, rolled):
    os.mkfifo(tmp_path / "baselines.json")
    with pytest.raises(RunError, match="a pipe"):
        score_baselines(make_bench(), tmp_path / "baselines.json")


def test_scenes_are_built_once_for_all_chunks(make_bench, monkeypatch):
    built = []

    def count(*words):
        built.append(1)
        return build_scenes(*words)

    monkeypatch.setattr(build, "build_scenes", count)
    monkeypatch.setattr("flashdex.envs.physics.base.build_scenes", count)
    bench = make_bench()

    def idle(td, env):
        return torch.zeros(env.num_envs, 2, env.bank.num_joints)

    one = list(roll_all(bench, idle, worlds=32))
    # chunks of two and one, the spare world of the last one rolls along
    two = list(roll_all(bench, idle, worlds=2))
    bench.make_env()
    assert len(built) == 1
    for a, b in zip(one, two, strict=True):
        assert a.motion == b.motion
        assert np.array_equal(a.qpos, b.qpos)
