"""Every limit at, below and above: signals are given, so that numbers are exact."""

import math
from dataclasses import replace

import pytest
import torch

from flashdex.errors import UnknownNameError
from flashdex.metrics.criteria import (
    moves_too_little,
    resolve_criterion,
    score,
    stays_behind,
    worst_movement,
)
from flashdex.metrics.errors import TrackingErrors

T, GRACE = 47, 15
DEG = math.pi / 180


def signals(**values):
    """Both hands with an object each; the named signal takes one value on the right."""

    def field(key, *shape):
        table = torch.zeros(T, 2, *shape, dtype=torch.float64)
        table[:, 1] = values.get(key, 0.0)
        return table

    offset = torch.zeros(T, 2, 3, dtype=torch.float64)
    offset[:, 1, 0] = values.get("object_pos", 0.0)
    sway = values.get("sway", 0.0)
    offset[:, 1, 1] += sway * torch.tensor([(-1.0) ** t for t in range(T)])
    ref = torch.zeros(T, 2, 3, dtype=torch.float64)
    ref[:, :, 2] = torch.linspace(0, 0.5, T)[:, None]
    return TrackingErrors(
        object_pos_offset=offset,
        object_rot_error=field("object_rot"),
        ref_object_pos=ref,
        fingertip_error=field("fingertip", 5),
        joint_error=field("joint"),
        wrist_pos_error=field("wrist_pos"),
        hand_active=(True, True),
        hand_object=(0, 1),
        num_frames=T,
        num_ref_frames=T,
        fps=60.0,
    )


# criterion, signal, limit of one hand, whether the limit itself passes. Means over two
# sides double what one side may do.
CASES = [
    *((n, "object_pos", 0.03, True) for n in ("sr_mt_obj", "sr_mt")),
    *((n, "object_rot", 30 * DEG, True) for n in ("sr_mt_obj", "sr_mt")),
    ("sr_mt", "fingertip", 0.06, True),
    ("sr_mt", "joint", 0.08, True),
    ("sr_mt_obj_x0.5", "object_pos", 0.015, True),
    ("sr_mt_obj_x0.5", "object_rot", 15 * DEG, True),
    ("sr_mt_obj_x2", "object_pos", 0.06, True),
    ("sr_mt_obj_x2", "object_rot", 60 * DEG, True),
    ("sr_mt_x0.5", "fingertip", 0.03, True),
    ("sr_mt_x0.5", "joint", 0.04, True),
    ("sr_mt_x2", "fingertip", 0.12, True),
    ("sr_mt_x2", "joint", 0.16, True),
    ("sr_mt_obj_moved", "object_pos", 0.03, True),
    ("sr_mt_obj_moved", "object_rot", 30 * DEG, True),
    ("sr_loose", "object_pos", 0.10, True),
    ("sr_loose", "object_rot", 30 * DEG, True),
    ("sr_mt_obj_frame", "object_pos", 0.03, True),
    ("sr_mt_frame", "fingertip", 0.06, True),
    ("sr_mt_frame", "joint", 0.08, True),
    ("sr_mt_obj_p95", "object_pos", 0.03, True),
    ("sr_mt_obj_p95", "object_rot", 30 * DEG, True),
    ("sr_mt_obj_flashchord", "object_pos", 0.03, False),
    ("sr_spider_raw", "object_pos", 0.20, False),
    ("sr_spider_raw", "object_rot", 1.0, False),
    ("sr_spider_centred", "object_rot", 1.0, True),
    ("sr_spider_flashchord", "object_pos", 0.20, True),
    ("sr_spider_worst", "object_pos", 0.10, False),
    ("sr_spider_worst", "object_rot", 0.5, False),
    ("chord_sr", "wrist_pos", 0.15, True),
    ("chord_sr", "object_pos", 0.10, True),
    ("chord_sr", "object_rot", 0.5, True),
]


@pytest.mark.parametrize(("name", "key", "limit", "_"), CASES)
def test_below_passes_and_above_fails(name, key, limit, _):
    below, above = (
        score(signals(**{key: limit * factor}))[name] for factor in (1 - 1e-6, 1 + 1e-6)
    )
    assert below.state == "passed"
    assert above.state == "failed"
    assert above.blamed_sides == ("right",)
    assert {b.term for b in above.blame} == {key}
    assert above.failing_frame >= above.grace or above.grace == 0


@pytest.mark.parametrize(
    ("name", "key", "limit", "passes"),
    [
        case
        for case in CASES
        # limits that a mean of equal numbers meets exactly
        if case[1] in ("object_rot", "wrist_pos") and case[2] in (0.5, 1.0, 0.15)
    ],
)
def test_the_limit_itself(name, key, limit, passes):
    verdict = score(signals(**{key: limit}))[name]
    assert verdict.is_passed is passes


def test_centred_limit():
    # a sway of +-a about zero has a centred error of about a; two sides halve it
    for factor, state in ((0.98, "passed"), (1.02, "failed")):
        verdict = score(signals(sway=0.20 * factor))["sr_spider_centred"]
        assert verdict.state == state


@pytest.mark.parametrize("frame", [GRACE - 1, GRACE, T - 1])
def test_one_bad_frame_counts_from_the_grace_on(frame):
    given = signals()
    given.object_rot_error[frame, 0] = 1.0
    verdict = score(given)["sr_mt_obj_frame"]
    assert verdict.is_passed is (frame < GRACE)
    if frame >= GRACE:
        assert (verdict.failing_frame, verdict.blamed_sides) == (frame, ("left",))


def test_result_carries_its_window():
    verdict = score(signals(), grace=7)["sr_mt_obj_x2"]
    assert (verdict.grace, verdict.num_scored, verdict.fps) == (7, T - 7, 60.0)
    assert verdict.limits == {"object_pos": 0.06, "object_rot": pytest.approx(60 * DEG)}


def test_names_resolve_and_unknown_names_are_explained():
    assert resolve_criterion("sr_spider") == "sr_spider_centred"
    assert resolve_criterion("sr_mt_obj_left") == "sr_mt_obj_left"
    with pytest.raises(UnknownNameError, match="Did you mean 'sr_mt_obj'"):
        resolve_criterion("sr_mt_objj")


@pytest.mark.parametrize(
    ("rise", "state"),
    [
        *((1.0, "passed"), (0.81, "passed"), (0.79, "failed"), (1.24, "passed")),
        *((1.26, "failed"), (0.0, "failed"), (-1.0, "failed")),
    ],
)
def test_an_object_has_to_rise_as_its_reference_does(rise, state):
    """Reference: 7 cm in the last third; standing still keeps a mean of 3 cm."""
    given = signals()
    ref = torch.zeros(T, 2, 3, dtype=torch.float64)
    ref[-T // 3 :, :, 2] = torch.linspace(0, 0.07, T // 3 + 1)[:, None]
    offset = torch.zeros_like(ref)
    offset[:, 1] = ref[:, 1] * (rise - 1)
    moved = replace(given, ref_object_pos=ref, object_pos_offset=offset)
    found = score(moved, grace=GRACE)
    assert found["sr_mt_obj"].state == ("failed" if rise < 0 else "passed")
    assert found["sr_mt_obj_moved"].state == state
    assert found["sr_mt_obj_moved_left"].is_passed
    ratio = worst_movement(moved)["lift"]
    assert ratio == pytest.approx(max(rise, 0.0))
    assert moves_too_little(worst_movement(moved)) == (rise < 0.8)


def _shaken(way):
    return 0.012 * torch.sin(40 * torch.linspace(0, 1, len(way)))[:, None] * Y


Y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
# reference: 4 cm along x in the middle third
CHEATS = {
    "still": lambda way: way * 0,
    "trembles": _shaken,
    "the other way": lambda way: -way,
    "across": lambda way: way[:, [1, 0, 2]],
    "at the very end": lambda way: way * (torch.arange(len(way)) > T - 4)[:, None],
    "a third of it": lambda way: way / 3,
}


@pytest.mark.parametrize("cheat", CHEATS)
@pytest.mark.parametrize("other", [1.0, 5.0], ids=["good", "overdone"])
def test_an_object_that_goes_elsewhere_stays_behind(cheat, other):
    """Also one of two, whatever the other does."""
    ref = torch.zeros(T, 2, 3, dtype=torch.float64)
    ref[:, :, 0] = 0.04 * (torch.linspace(-1, 2, T).clamp(0, 1))[:, None]
    way = ref[:, 1]
    offset = torch.zeros_like(ref)
    offset[:, 0] = way * (other - 1)
    given = replace(signals(), ref_object_pos=ref, object_pos_offset=offset)
    assert not stays_behind(given)
    offset[:, 1] = CHEATS[cheat](way) - way
    assert stays_behind(replace(given, object_pos_offset=offset))
