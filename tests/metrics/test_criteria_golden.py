"""Golden cases of the criteria: errors chosen so that every verdict is known."""

import math

import pytest
import torch

from flashdex.metrics.criteria import Limits, criterion_names, score
from flashdex.metrics.errors import frozen_object

T = 200


def constant(*errors, length=T):
    return torch.tensor(errors, dtype=torch.float64).expand(length, len(errors))


def states(scores, *names):
    return [scores[name].state for name in names]


def test_constant_offset_is_forgiven_by_centring_only(poses):
    scores = score(poses(constant(0.20)))
    assert scores["sr_spider_raw"].values["object_pos"] == pytest.approx(0.20)
    assert scores["sr_spider_centred"].values["object_pos_centred"] < 1e-9
    assert states(scores, "sr_spider_raw", "sr_spider_centred", "sr_mt_obj") == [
        "failed",
        "passed",
        "failed",
    ]


def test_averaging_forgives_one_bad_object(poses):
    scores = score(poses(constant(0.18, 0.01)))
    assert scores["sr_spider_raw"].values["object_pos"] == pytest.approx(0.095)
    assert scores["sr_spider_worst"].values["object_pos"] == pytest.approx(0.18)
    assert states(scores, "sr_spider_raw", "sr_spider_worst", "sr_mt_obj") == [
        "passed",
        "failed",
        "failed",
    ]
    assert scores["sr_spider_worst"].blamed_sides == ("left",)


def test_static_side_is_dropped(poses):
    scores = score(poses(constant(0.18, 0.01), moving=[1.0, 0.0]))
    assert scores["sr_spider_raw"].values["object_pos"] == pytest.approx(0.18)
    assert scores["sr_spider_raw"].state == "failed"
    assert scores["sr_spider_flashchord"].values["object_pos"] == pytest.approx(0.095)
    assert scores["sr_spider_flashchord"].state == "passed"


@pytest.mark.parametrize(("scale", "state"), [(0.99, "not_measured"), (1.01, "passed")])
def test_a_millimetre_of_mean_drift_decides_what_is_static(poses, scale, state):
    # the reference of the fixture rises linearly by .3 m: its mean drift is .15 m
    verdict = score(poses(constant(0.0), moving=[scale * 1e-3 / 0.15]))
    assert verdict["sr_spider_centred"].state == state
    expected = "static_reference" if state == "not_measured" else ""
    assert verdict["sr_spider_centred"].reason == expected
    assert verdict["sr_mt_obj"].state == "passed"


def test_bad_end_passes_the_mean_only(poses):
    errors = torch.zeros(T, 1, dtype=torch.float64)
    errors[-T // 10 :] = 0.25
    scores = score(poses(errors), grace=0)
    assert scores["sr_mt_obj"].values["object_pos"] == pytest.approx(0.025)
    assert scores["sr_mt_obj_p95"].values["object_pos"] == pytest.approx(0.25)
    assert states(scores, "sr_mt_obj", "sr_mt_obj_frame", "sr_mt_obj_p95") == [
        "passed",
        "failed",
        "failed",
    ]
    assert scores["sr_mt_obj_frame"].failing_frame == T - T // 10


def test_grace_hides_the_first_steps(poses):
    errors = torch.zeros(T, 1, dtype=torch.float64)
    errors[:15] = 0.031
    signals = poses(errors)
    scores = score(signals)
    assert states(scores, "sr_mt_obj", "sr_mt_obj_frame") == ["passed", "passed"]
    assert scores["sr_mt_obj"].num_scored == T - 15
    assert score(signals, grace=14)["sr_mt_obj_frame"].failing_frame == 14
    strict = score(signals, grace=0)
    assert states(strict, "sr_mt_obj", "sr_mt_obj_frame") == ["passed", "failed"]


def test_error_on_the_limit_passes_unless_strict(poses):
    limits = Limits(object_pos=1 / 32, spider_pos=1 / 32)
    scores = score(poses(constant(1 / 32)), limits=limits)
    names = ("sr_mt_obj", "sr_mt_obj_frame", "sr_mt_obj_flashchord")
    assert states(scores, *names) == ["passed", "passed", "failed"]
    assert states(scores, "sr_spider_raw", "sr_spider_flashchord") == [
        "failed",
        "passed",
    ]


def test_left_passes_and_right_fails(poses):
    scores = score(poses(constant(0.0, 0.05)))
    assert states(scores, "sr_mt_obj", "sr_mt_obj_left", "sr_mt_obj_right") == [
        "failed",
        "passed",
        "failed",
    ]
    assert scores["sr_mt_obj"].blamed_sides == ("right",)


def test_each_quantity_blames_its_own_hand(poses):
    turns = constant(0.0, math.radians(31))
    verdict = score(poses(constant(0.031, 0.0), turns))["sr_mt_obj"]
    assert verdict.state == "failed"
    assert [(b.side, b.term) for b in verdict.blame] == [
        ("left", "object_pos"),
        ("right", "object_rot"),
    ]
    assert verdict.blamed_sides == ("left", "right")


def test_shared_object_counts_once_per_hand(poses):
    # two slots, both hands on slot 0: the means over sides see it twice
    scores = score(poses(constant(0.05, 0.5), hand_object=(0, 0)))
    for name in ("sr_spider_raw", "sr_spider_flashchord"):
        assert scores[name].values["object_pos"] == pytest.approx(0.05)
    assert score(poses(constant(0.04, 9.0), hand_object=(0, 0)))[
        "sr_mt_obj"
    ].blamed_sides == ("left", "right")


def test_absent_hand_and_object_are_left_out(poses):
    errors = constant(float("nan"), 0.01)
    scores = score(poses(errors, hand_active=(False, True)))
    assert scores["sr_mt_obj"].state == "passed"
    assert scores["sr_mt_obj_left"].state == "not_measured"
    assert scores["sr_mt_obj_left"].reason == "hand_absent"
    lone = score(poses(constant(0.0, 0.01), hand_object=(-1, 1)))
    assert lone["sr_mt_obj"].values["object_pos"] == pytest.approx(0.01)
    assert lone["sr_mt_obj_left"].reason == "no_object"


def test_not_a_number_fails_and_never_passes(poses):
    errors = torch.zeros(T, 1, dtype=torch.float64)
    errors[3] = float("nan")  # within the grace: the state is corrupt all the same
    scores = score(poses(errors))
    measured = {n: v for n, v in scores.items() if v.state != "not_measured"}
    assert {v.reason for v in measured.values()} == {"numerics"}
    assert scores["sr_mt_obj"].state == "failed"


def test_engine_overflow_is_numerics(poses):
    assert score(poses(constant(0.0), overflow=True))["sr_mt_obj"].reason == "numerics"


def test_short_rollout_is_incomplete(poses):
    almost = score(poses(constant(0.0), num_ref_frames=T + 1))
    assert almost["sr_mt_obj"].state == "passed"
    short = poses(constant(0.0), num_ref_frames=T + 2)
    assert states(score(short), "sr_mt_obj", "sr_spider_raw") == ["failed", "failed"]
    assert score(short)["sr_mt_obj"].reason == "incomplete"
    partial = score(short, partial=True)
    assert states(partial, "sr_mt_obj", "sr_spider_raw") == ["failed", "passed"]


def test_missing_hand_data_names_its_key(poses):
    scores = score(poses(constant(0.0)))
    assert scores["sr_mt"].state == "not_measured"
    assert scores["sr_mt"].reason == "missing:fingertips"
    assert scores["chord_sr"].reason == "missing:wrist_pos"


def test_completed_needs_the_training_terminations(poses):
    signals = poses(constant(0.5))
    expected = {None: "not_measured", True: "passed", False: "failed"}
    for completed, state in expected.items():
        assert score(signals, completed=completed)["completed"].state == state


def test_too_short_for_the_grace(poses):
    scores = score(poses(constant(0.0, length=15)))
    assert scores["sr_mt_obj"].reason == "no_scored_frames"
    assert scores["sr_spider_raw"].state == "passed"


def test_frozen_object_is_trivial_for_spider_only():
    ref = torch.zeros(T, 1, 3, dtype=torch.float64)
    ref[:, 0, 0] = torch.linspace(0, 0.16, T)  # .08 m from its start on average
    quat = torch.tensor([1.0, 0, 0, 0]).expand(T, 1, 4)
    masks = {"hand_active": (False, True), "hand_object": (-1, 0)}
    scores = score(frozen_object(ref, quat, **masks))
    assert states(scores, "sr_spider_raw", "sr_mt_obj") == ["passed", "failed"]


def test_every_name_is_scored_for_both_hands_and_each(poses):
    scores = score(poses(constant(0.0)))
    assert list(scores) == criterion_names()
    assert "sr_mt_obj_x0.5_left" in scores
