"""Counts of a run from its lines."""

import math

import pytest

from flashdex.metrics.tally import (
    UNMOVED,
    Tally,
    follow_misses,
    is_nearer,
    miss_distance,
)


def line(*trivial, verdict=None, converted=True):
    return {
        "motion": "lift",
        "criterion": "sr_mt_obj",
        "converted": converted,
        "certified": verdict == "robust",
        "verdict": verdict,
        "trivial": list(trivial),
    }


def test_a_proof_without_movement_proves_no_movement():
    lines = [line(verdict="failed"), line(UNMOVED, verdict="robust")]
    tally = Tally(["lift", "push"], "sr_mt_obj", lines)
    assert (tally.num_converted, tally.num_certified) == (1, 0)
    tally.count(line(verdict="robust"))
    assert (tally.num_converted, tally.num_certified) == (1, 1)


def test_a_later_movement_counts_with_its_own_proof():
    tally = Tally(["lift"], "sr_mt_obj", [line(UNMOVED, verdict="robust")])
    assert tally.note == "0 of 1 converted, and 1 trivial"
    tally.count(line(verdict="failed"))
    assert tally.note == "1 of 1 converted, 0 certified"


def test_what_fails_or_is_of_others_does_not_count():
    lines = [line(converted=False), {**line(), "motion": "x"}]
    lines += [{**line(), "criterion": "sr_loose"}]
    tally = Tally(["lift"], "sr_mt_obj", lines)
    assert (tally.num_passed, tally.num_attempts) == (0, 1)


def attempt(share=0.0, frame=100, *trivial, **more):
    """A failed attempt whose rotation is that share of its limit; 0: cut short."""
    errors = (
        {"object_pos": 0.0, "object_rot": share * math.radians(30)} if share else {}
    )
    found = {**line(*trivial, converted=False), "completed": bool(share)}
    return {**found, "errors": errors, "frame": frame, **more}


def test_the_nearest_miss_moves_then_lasts_then_errs_least():
    order = [
        attempt(1.1),
        attempt(2.0),
        attempt(frame=90),
        attempt(frame=40),
        attempt(1.01, 100, UNMOVED),
        attempt(0, 99, UNMOVED),
    ]
    shuffled = order[::-1]
    assert sorted(shuffled, key=miss_distance) == order
    assert miss_distance(order[0])[2] == pytest.approx(1.1)


def test_a_miss_gives_way_to_one_nearer_by_a_tenth():
    assert is_nearer(attempt(2.0), None)
    assert is_nearer(attempt(1.79), attempt(2.0))
    assert not is_nearer(attempt(1.81), attempt(2.0))
    assert is_nearer(attempt(1.9), attempt(frame=99))
    assert not is_nearer(attempt(frame=43), attempt(frame=40))
    assert is_nearer(attempt(frame=45), attempt(frame=40))
    diverged = attempt(math.inf)
    assert not is_nearer(diverged, None)
    assert not is_nearer(attempt(math.nan), None)


def test_a_miss_is_kept_until_its_motion_moves_in_a_pass():
    misses, near = {}, attempt(2.0, miss="misses/lift.npz")
    for told in (near, attempt(3.0), line(), line(UNMOVED) | {"rollout": "x"}):
        follow_misses(misses, told)
        assert misses == {"lift": near}
    follow_misses(misses, line() | {"rollout": "x"})
    assert misses == {}
