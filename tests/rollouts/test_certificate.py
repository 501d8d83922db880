"""Certificates on a box that a finger pushes: the rollout comes from plain MuJoCo C."""

import json
from dataclasses import replace

import numpy as np
import pytest

from flashdex.envs.scene.perturbation import Perturbation
from flashdex.errors import FlashdexError, UnknownNameError
from flashdex.metrics.criteria_table import criterion_names
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.rollout import Rollout


def moved(rollout):
    path = np.linalg.norm(rollout.object_pos[-1, 0] - rollout.object_pos[0, 0])
    return float(path)


def test_untouched_rollout_certifies_with_zero_deviation(rollout):
    assert moved(rollout) > 0.1  # the finger did push
    certificate = certify(rollout)
    assert certificate.verdict == "robust"
    assert certificate.reason == ""
    assert certificate.deviation["max_mm"] == 0.0
    assert certificate.deviation["max_deg"] == 0.0
    assert certificate.deviation["first_frame_beyond"] == -1
    assert certificate.deviation["stored_mismatch_mm"] == 0.0
    nominal = certificate.nominal["sr_mt"]
    assert nominal["state"] == "passed"
    # tips and links come back from sites and bodies at the values of the oracle
    assert max(nominal["values"].values()) < 1e-12


def test_every_criterion_is_in_the_certificate(rollout):
    certificate = certify(rollout, num_perturbations=2)
    assert list(certificate.nominal) == criterion_names()
    assert list(certificate.perturbed["pass_fraction"]) == criterion_names()
    assert certificate.nominal["completed"]["state"] == "not_measured"
    assert certificate.perturbed["pass_fraction"]["completed"] is None


def test_tampered_control_fails(rollout):
    ctrl = rollout.ctrl.copy()
    ctrl[20:] = 0.0  # the finger goes back
    certificate = certify(replace(rollout, ctrl=ctrl), num_perturbations=1)
    assert certificate.verdict == "failed"
    assert certificate.reason == "limit"
    assert 20 <= certificate.deviation["first_frame_beyond"] < 30
    assert certificate.deviation["end_mm"] > 50
    blamed = {b["term"] for b in certificate.nominal["sr_mt"]["blame"]}
    assert "object_pos" in blamed


def test_certifying_twice_is_identical(rollout, tmp_path):
    loaded = Rollout.load(rollout.save(tmp_path / "push.npz"))
    texts = {certify(r).to_json() for r in (rollout, loaded, loaded)}
    assert len(texts) == 1
    assert certify(rollout, seed=1).to_json() not in texts


def test_static_box_survives_every_perturbation(build_rollout):
    still = build_rollout(push=0.0, criterion="sr_mt_obj")
    certificate = certify(still)
    assert certificate.verdict == "robust"
    assert certificate.perturbed["pass_fraction"]["sr_mt_obj"] == 1.0
    assert certificate.perturbed["counts"]["sr_mt_obj"]["passed"] == 8
    assert certificate.nominal["sr_spider_centred"]["reason"] == "static_reference"


def test_perturbations_beyond_the_limits_are_certified_not_robust(build_rollout):
    still = build_rollout(push=0.0, criterion="sr_mt_obj_x0.5")
    # first pose off by up to 10 cm per axis against a limit of 1.5 cm
    certificate = certify(still, sizes=Perturbation(object_pos=0.1))
    assert certificate.verdict == "certified"
    assert certificate.perturbed["pass_fraction"]["sr_mt_obj_x0.5"] < 0.75
    failing = [
        run["sr_mt_obj_x0.5"]["failing_frame"]
        for run in certificate.perturbed["runs"]
        if run["sr_mt_obj_x0.5"]["state"] == "failed"
    ]
    assert failing
    assert all(frame >= 15 for frame in failing)


def test_six_of_eight_is_the_line(rollout):
    from flashdex.rollouts import certificate as module

    nominal = certify(rollout, num_perturbations=0)
    assert nominal.verdict == "certified"
    passed = rollout.score()["sr_mt"]
    failed = replace(passed, state="failed", reason="limit")
    for count, verdict in ((5, "certified"), (6, "robust"), (8, "robust")):
        runs = [passed] * count + [failed] * (8 - count)
        assert module._decide(passed, runs, is_assisted=False)[0] == verdict
    # other numbers of runs keep the share: 3 of 3, since 2 are less than three quarters
    runs = [passed, passed, failed]
    assert module._decide(passed, runs, is_assisted=False)[0] == "certified"
    assert module._decide(failed, [passed] * 8, is_assisted=False)[0] == "failed"


def test_criterion_that_cannot_be_measured(build_rollout):
    static = build_rollout(push=0.0, criterion="sr_spider")
    certificate = certify(static, num_perturbations=0)
    assert certificate.verdict == "not_measured"
    assert certificate.reason == "static_reference"


def test_stored_assist_is_no_conversion(build_rollout):
    wrench = np.zeros((90, 1, 6))
    assert certify(build_rollout(wrench=wrench), num_perturbations=0).verdict == (
        "certified"
    )
    wrench[50, 0, 2] = 1e-3
    certificate = certify(build_rollout(wrench=wrench), num_perturbations=0)
    assert (certificate.verdict, certificate.reason) == ("failed", "assist")


@pytest.mark.parametrize(
    ("old", "new", "source"),
    [
        ('<body name="box"', '<body name="box" gravcomp="1"', "gravcomp"),
        (
            "</actuator>",
            '<motor joint="box" gear="0 0 1 0 0 0"/></actuator>',
            "actuator",
        ),
        (
            "<actuator>",
            '<equality><weld body1="box"/></equality><actuator>',
            "equality",
        ),
        ('integrator="', 'gravity="0 0 -1" integrator="', "gravity"),
    ],
)
def test_assist_hidden_in_the_model_is_found(
    build_rollout, scene_xml, old, new, source
):
    xml = scene_xml.replace(old, new)
    ctrl = {"ctrl": np.zeros((90, 2))} if source == "actuator" else {}
    if ctrl:
        base = build_rollout()
        given = replace(base, model_xml=xml, model_sha256="", **ctrl)
    else:
        given = build_rollout(xml)
    certificate = certify(given, num_perturbations=0)
    assert certificate.inputs["assist_sources"] == [source]
    assert certificate.verdict == "failed"


def test_diverging_controls_fail_as_numerics(rollout, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings to the working directory
    ctrl = rollout.ctrl.copy()
    ctrl[40] = np.nan
    certificate = certify(replace(rollout, ctrl=ctrl), num_perturbations=0)
    assert certificate.safety["warnings"]["mjWARN_BADCTRL"] > 0
    assert certificate.verdict == "failed"
    velocity = rollout.qvel0.copy()
    velocity[1] = np.nan
    broken = certify(replace(rollout, qvel0=velocity), num_perturbations=0)
    assert (broken.verdict, broken.reason) == ("failed", "numerics")
    assert broken.safety["nan_count"] > 0
    json.loads(broken.to_json())


def test_fingertips_without_sites_are_not_measured(build_rollout, scene_xml):
    xml = scene_xml.replace('name="left_pad_ring"', 'name="other"')
    given = replace(build_rollout(), model_xml=xml, model_sha256="")
    certificate = certify(given, num_perturbations=0)
    assert certificate.nominal["sr_mt"]["reason"] == "missing:fingertips"
    assert certificate.nominal["sr_mt_obj"]["state"] == "passed"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object_qpos_adr": np.array([0])}, "no free joint"),
        ({"joint_bodies": '[["left_base", "nobody"], []]'}, "'nobody' is not in"),
        ({"joint_bodies": '[["left_base"], []]'}, "two lists"),
        ({"ctrl": np.zeros((90, 3))}, "ctrl has 3 columns, the model needs 1"),
        (
            {"model_xml": "<mujoco><x/></mujoco>", "model_sha256": ""},
            "<x> is not allowed",
        ),
    ],
)
def test_file_that_does_not_fit_its_model_is_refused(rollout, change, message):
    with pytest.raises(FlashdexError, match=message):
        certify(replace(rollout, **change))


def test_absent_hand_need_not_be_in_the_model(rollout):
    links = '[["left_base", "left_tip"], ["right_base", "right_tip"]]'
    certificate = certify(replace(rollout, joint_bodies=links), num_perturbations=0)
    assert certificate.nominal["sr_mt"]["state"] == "passed"


def test_unknown_criterion_is_refused(rollout):
    with pytest.raises(UnknownNameError):
        certify(replace(rollout, criterion="success"))


def test_certificate_is_a_json_file(rollout, tmp_path):
    path = certify(rollout, num_perturbations=1).save(tmp_path / "c" / "push.json")
    data = json.loads(path.read_text())
    assert data["identity"]["schema"] == 2
    assert len(data["identity"]["rollout_sha256"]) == 64
    assert data["identity"]["certified_by"]["engine"] == "mujoco"
    assert len(data["model"]["compiled_sha256"]) == 64
    assert data["model"]["iterations"] >= 100
    assert data["provenance"]["env_steps"] == 1000
    assert [p.name for p in path.parent.iterdir()] == ["push.json"]


def test_scored_positions_that_are_not_the_stored_states_prove_nothing(rollout):
    shifted = replace(rollout, object_pos=rollout.object_pos + 0.001)
    certificate = certify(shifted, num_perturbations=0)
    assert (certificate.verdict, certificate.reason) == ("failed", "stored_states")
