"""Counts of a run from its lines."""

from flashdex.metrics.tally import UNMOVED, Tally


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
