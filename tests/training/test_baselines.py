"""What no learning achieves, on motions whose outcome is known."""

from __future__ import annotations

import json

from flashdex.cli.main import main
from flashdex.training.baselines import Baselines, format_baselines


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
    scores = json.loads(out.read_text())
    assert set(scores) == {"do_nothing", "kinematic_playback", "frozen_object"}
    assert list(scores["do_nothing"]) == library.names


def test_gym_recipe_has_no_baselines(capsys):
    assert main(["baselines", "gym_halfcheetah"]) == 2
    assert "gym" in capsys.readouterr().err
