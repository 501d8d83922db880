"""The plain learner of the benchmark and the library's compute the same thing."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks import learner as bench
from benchmarks.common.ceilings import (
    Product,
    count_products,
    replay_seconds,
    total_flops,
)
from benchmarks.common.plain_flashsac import PlainLearner, read_batch
from benchmarks.learner import LearnerSize, make_batch, make_loss
from flashdex.modules.product import multiply
from flashdex.objectives.stepper import FlashSACStepper

ONE = LearnerSize(9, 3, 1, 32, 24, 16)
TWO = LearnerSize(9, 3, 2, 32, 16, 16, future=5, latent=6, channels=(8, 7, 6))


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request):
    torch.set_default_dtype(request.param)
    yield request.param
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("size", [ONE, TWO], ids=["one group", "two groups, future"])
def test_both_learners_agree_over_several_updates(size, dtype):
    """float64 is exact; in float32 Adam turns rounding into steps of its rate."""
    tolerance = {"rtol": 1e-9, "atol": 1e-9}
    if dtype == torch.float32:
        tolerance = {"rtol": 1e-3, "atol": 1e-4}
    torch.manual_seed(0)
    loss = make_loss(size)
    plain, stepper = PlainLearner(loss), FlashSACStepper(loss)
    for seed in range(6):
        td = make_batch(size, seed=seed)
        noise = {
            name: torch.randn(size.groups, size.batch, size.action)
            for name in ("actor_noise", "target_noise")
        }
        found = stepper.update(td, **noise)
        wanted = plain.update(read_batch(td, loss), **noise)
        for name, value in wanted.items():
            ours = torch.stack([found[group, name] for group in loss.groups])
            torch.testing.assert_close(ours, value, **tolerance)
    ours, theirs = PlainLearner(loss).state_dict(), plain.state_dict()
    statistics = [name for name in theirs if "running" in name]
    for name in theirs if dtype == torch.float64 else statistics:
        torch.testing.assert_close(ours[name], theirs[name], **tolerance)


def test_main_prints_one_json_object_a_size(monkeypatch, capsys):
    monkeypatch.setitem(bench.SIZES, "tiny", TWO)
    before = torch.get_num_threads()
    out = bench.main(["--sizes", "tiny", "--rounds", "2", "--threads", "1"])
    assert torch.get_num_threads() == before
    printed = capsys.readouterr().out.strip().splitlines()
    assert [json.loads(line) for line in printed] == out
    (result,) = out
    wanted = {"benchmark", "hardware", "commit", "torch", "torch_threads", "split"}
    wanted |= {"ms_per_update_eager", "baseline_ms_per_update", "ratio_to_baseline"}
    assert wanted <= result.keys()
    assert result["ratio_to_baseline"] == result["ratio_to_baseline_eager"] > 0
    assert set(result["split"]) == {"read", "actor", "critic", "step"}
    # at least the blocks of the critics, forward, over both halves of the batch
    layers = 2 * TWO.batch * TWO.groups * 2 * 2 * 8 * TWO.critic**2 * 2
    assert result["gflop_per_update"] > layers / 1e9
    assert result["ceiling_ms_per_update"] > 0


def test_products_are_counted_from_shapes():
    """5 x 7 by 7 x 3, the gradient of its left side, a batch of two, a large one."""
    left, right = torch.randn(5, 7, requires_grad=True), torch.randn(7, 3)
    batch = torch.randn(2, 4, 6), torch.randn(2, 6, 8)
    x, weight = torch.randn(1, 160, 150), torch.randn(1, 140, 150)

    def call():
        (left @ right).sum().backward()
        torch.bmm(*batch)
        multiply(x, weight)

    call()
    counts = count_products(call, repeat=3)
    assert counts == {
        Product(1, 5, 7, 3): 1,
        Product(1, 5, 3, 7): 1,
        Product(2, 4, 6, 8): 1,
        Product(1, 160, 150, 140): 1,
    }
    assert total_flops(counts) == 2 * (2 * 105 + 2 * 192 + 160 * 150 * 140)
    assert replay_seconds(counts, repeat=3) > 0
