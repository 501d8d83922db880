"""The verbs that read a run: exit codes and what they print."""

import json
import re

import numpy as np
import pytest

from flashdex.cli.runs import _show_run
from flashdex.metrics.criteria import score
from flashdex.rollouts.rollout import Rollout


def test_report_rewrites_the_page(call, run_dir):
    code, out, _ = call("report", run_dir)
    assert code == 0
    assert out.strip() == str(run_dir / "report.html")
    (run_dir / "report.html").write_text("old")
    assert call("report", run_dir)[0] == 0
    assert "12,345" in (run_dir / "report.html").read_text()


def test_a_finished_training_shows_table_and_page(run_dir, capsys):
    _show_run(run_dir)
    out = capsys.readouterr().out
    assert "1 of 5 converted by sr_mt_obj" in out
    assert out.splitlines()[-1] == f"report: {run_dir / 'report.html'}"
    assert (run_dir / "report.html").is_file()


def test_replay_holds(call, converted_run):
    code, out, _ = call("replay", converted_run)
    assert code == 0
    assert out.split() == ["right_box", "stored", "robust", "found", "robust", "holds"]


def test_replay_without_the_library_says_what_was_not_checked(call, spoilt_run):
    recipe = spoilt_run / "recipe.yaml"
    text = recipe.read_text()
    (library,) = re.findall(r"^ *library: (.*)$", text, re.MULTILINE)
    recipe.write_text(text.replace(library, "nowhere"))
    code, out, _ = call("replay", spoilt_run)
    assert code == 1  # the recipe was changed
    assert "DIFFERS  rollouts/right_box.npz: recipe" in out
    assert "not checked against a library: " in out
    assert "not checked  roles, reference, first state, actions, criterion" in out


def test_replay_of_tampered_controls_is_one(call, spoilt_run):
    path = spoilt_run / "rollouts" / "right_box.npz"
    with np.load(path) as file:
        data = dict(file)
    data["ctrl"][10:] = data["ctrl"][10]  # the hand stops; the stored states go on
    np.savez(path, **data)
    code, out, _ = call("replay", spoilt_run)
    assert code == 1
    assert "DOES NOT HOLD" in out
    assert "DIFFERS  rollouts/right_box.npz: qpos: leaves what the controls" in out
    assert "DIFFERS  rollouts/right_box.npz: ctrl: is up to" in out


def test_replay_of_an_embellished_certificate_is_one(call, spoilt_run):
    path = spoilt_run / "rollouts" / "right_box.certificate.json"
    certificate = json.loads(path.read_text())
    certificate["nominal"]["sr_mt_obj"]["values"]["object_pos"] *= 0.5
    path.write_text(json.dumps(certificate))
    code, out, _ = call("replay", spoilt_run)
    assert code == 1
    assert "nominal.sr_mt_obj.values.object_pos is 0.00" in out


def test_score_says_what_it_did_not_check(call, converted_run):
    code, out, _ = call("score", converted_run / "rollouts" / "right_box.npz")
    assert code == 0
    assert "not checked  roles, reference, first state, actions, criterion" in out


def test_score_refuses_what_replay_would_refuse(call, spoilt_run):
    path = spoilt_run / "rollouts" / "right_box.npz"
    with np.load(path) as file:
        data = dict(file)
    data["fingertips"] = data["ref_fingertips"]
    np.savez(path, **data)
    for words in ([path], [path, "--json"]):
        code, out, err = call("score", *words)
        assert code == 1
        assert "fingertips: is up to" in out + err


def test_score_json_agrees_with_the_library(call, run_dir, rollout):
    path = run_dir / "rollouts" / "push.npz"
    code, out, err = call("score", path, "--json")
    assert code == 1  # a rollout that does not say where it comes from
    assert "provenance" in err
    found = json.loads(out)[str(path)]
    loaded = Rollout.load(path)
    expected = score(loaded.tracking_errors(), grace=loaded.grace)
    assert list(found) == list(expected)
    for name, verdict in expected.items():
        assert found[name]["state"] == verdict.state
        assert found[name]["reason"] == verdict.reason
        assert found[name]["values"] == dict(verdict.values)
    states = {verdict["state"] for verdict in found.values()}
    assert {"passed", "not_measured"} <= states


def test_score_prints_a_table_a_file(call, run_dir):
    path = run_dir / "rollouts" / "push.npz"
    code, out, _ = call("score", path, path.with_name("./push.npz"))
    assert code == 1
    assert out.startswith(str(path))
    assert "object 5.0/30 mm" in out


@pytest.mark.parametrize(
    ("verb", "expected"),
    [
        ("report", "not a run directory"),
        ("replay", "not a run directory"),
        ("score", "no such file"),
        ("evaluate", "not a run directory"),
    ],
)
def test_mistakes_are_two(call, tmp_path, verb, expected):
    code, out, err = call(verb, tmp_path / "nothing")
    assert (code, out) == (2, "")
    assert expected in err
