"""Rates, MOPE and MORE."""

import pytest
import torch

from flashdex.metrics.aggregate import Rate, mean_object_errors, mope_more, rates
from flashdex.metrics.criteria import score

T = 60


def constant(*errors):
    return torch.tensor(errors, dtype=torch.float64).expand(T, len(errors))


def test_not_measured_is_shown_and_not_counted():
    rate = Rate.of(["passed"] * 43 + ["failed"] * 7 + ["not_measured"] * 2)
    assert str(rate) == "43/50 (2 n.m.)"
    assert rate.value == 43 / 50
    assert Rate.of(["not_measured"]).value is None


def test_rates_of_a_collection(poses):
    scores = [score(poses(constant(e))) for e in (0.0, 0.02, 0.05)]
    scores.append(score(poses(constant(0.0), moving=[0.0])))
    table = rates(scores)
    assert str(table["sr_mt_obj"]) == "3/4 (0 n.m.)"
    assert str(table["sr_spider_centred"]) == "3/3 (1 n.m.)"
    assert str(table["sr_mt"]) == "0/0 (4 n.m.)"


def test_mope_is_over_spider_passes_and_mope_all_over_everything(poses):
    turn = constant(0.0, 0.2)
    good = poses(constant(0.01, 0.03), turn)
    bad = poses(torch.linspace(0, 2, T).double()[:, None].expand(T, 2))
    motions = [
        (mean_object_errors(s), score(s)["sr_spider_centred"]) for s in (good, bad)
    ]
    assert [v.state for _, v in motions] == ["passed", "failed"]
    result = mope_more(motions)
    assert result["mope"] == pytest.approx(20.0)
    assert result["more"] == pytest.approx(0.1)
    assert result["mope_all"] == pytest.approx((20 + 1000) / 2)
    assert result["more_all"] == pytest.approx(0.05)
    assert (result["mope_motions"], result["mope_all_motions"]) == (1, 2)
    assert mope_more([])["mope"] is None


def test_errors_that_are_not_numbers_do_not_enter_means(poses):
    assert mean_object_errors(poses(constant(float("nan")))) is None
