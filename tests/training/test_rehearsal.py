"""Walking an update without memory, against updates that were really made."""

from __future__ import annotations

import pytest
import torch

from benchmarks.common.ceilings import count_products, total_flops
from flashdex.algorithms.agent import make_actor, make_critic, walk_update
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.footprint import Networks, PeakMeter
from flashdex.objectives.batch import FlashBatch
from flashdex.objectives.flashsac import FlashSACLoss

FUTURE = (12, 10)
SMALL = {"actor_width": 32, "critic_width": 48, "future_channels": [16, 16, 8]}


def make_loss(device, **values):
    algo = AlgoConfig(**{**SMALL, **values})
    with torch.device(device):
        sizes = (90, 7, 2, FUTURE)
        actor, critic = make_actor(algo, *sizes), make_critic(algo, *sizes)
        return FlashSACLoss(actor, critic, groups=["left", "right"])


def make_batch(loss, size, device):
    with torch.device(device):
        batch = FlashBatch(
            observation=torch.randn(2 * size, 90),
            future=torch.randn(2 * size, *FUTURE[::-1]).mT,
            action=torch.rand(size, 14),
            reward=torch.randn(2, size),
            discount=torch.ones(size),
            terminated=torch.zeros(size),
            weight=torch.ones(2, size),
        )
        return batch, torch.randn(2, size, 7)


def walk_flashsac(loss, batch, noise, **options):
    return walk_update(loss, batch, noise, **options)[0]


def test_meter_counts_storages_not_views():
    with PeakMeter() as meter:
        x = torch.zeros(1000)
        y = x.view(10, 100)[3]
        z = x + 1
        del x, y
        assert meter.now == 4000
        assert meter.peak == 8000
        z.add_(1)
        assert meter.peak == 8000
    del z
    assert meter.now == 0


def saved_bytes(objective, batch, noise, network):
    """Bytes that autograd keeps of one forward pass, parameters and inputs not."""
    kept = {}

    def note(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    given = [*network.parameters(), *(t for t in batch if t is not None), noise]
    with torch.autograd.graph.saved_tensors_hooks(note, lambda t: t):
        value, _ = objective(batch, noise)
    for tensor in given:
        kept.pop(tensor.untyped_storage().data_ptr(), None)
    del value
    return sum(kept.values())


@pytest.mark.parametrize("size", [64, 256])
def test_activations_are_what_autograd_saves_and_some_more(size):
    walked = walk_flashsac(
        make_loss("meta"), *make_batch(make_loss("meta"), size, "meta")
    )
    loss = make_loss("cpu")
    batch, noise = make_batch(loss, size, "cpu")
    saved = max(
        saved_bytes(objective, batch, noise, loss)
        for objective in (loss.actor_objective, loss.qvalue_objective)
    )
    # on top come the results under way: the targets, and gradients of activations
    assert saved <= walked <= 1.8 * saved


@pytest.mark.parametrize("lowered", [False, True], ids=["float32", "bfloat16"])
def test_the_peak_is_that_of_a_real_update(lowered):
    size, found = 256, {}
    for device in ("meta", "cpu"):
        loss = make_loss(device, critic_width=64)
        batch, noise = make_batch(loss, size, device)
        found[device] = walk_flashsac(loss, batch, noise, lowered=lowered)
        assert all(p.grad is None for p in loss.parameters())
    # kernels of the CPU may make a copy that the walk does not see, or spare one
    assert found["meta"] == pytest.approx(found["cpu"], rel=0.1)


def test_activations_grow_with_the_batch():
    loss = make_loss("meta")
    few, some, many = (
        walk_flashsac(loss, *make_batch(loss, size, "meta"))
        for size in (512, 1024, 2048)
    )
    assert many - some == pytest.approx(2 * (some - few), rel=0.05)


def test_gradients_are_not_counted_twice():
    loss = make_loss("meta", critic_width=256)
    walked = walk_flashsac(loss, *make_batch(loss, 2, "meta"))
    # Of two rows the activations are nothing beside the weights. The actor's step holds
    # one copy of the critic's weights, with frozen statistics folded in; the critic's a
    # quarter (one layer on its way) on top of the gradients.
    assert walked < 1.05 * Networks.of(loss.qvalue_network).gradients


@pytest.mark.parametrize("period", [1, 2])
def test_products_are_those_the_profiler_sees(period):
    _, walked = walk_update(
        make_loss("meta"),
        *make_batch(make_loss("meta"), 64, "meta"),
        actor_period=period,
    )
    loss = make_loss("cpu")
    batch, noise = make_batch(loss, 64, "cpu")

    def run(objective):
        value, _ = objective(batch, noise)
        value.backward()

    actor, critic = (
        total_flops(count_products(lambda o=objective: run(o)))
        for objective in (loss.actor_objective, loss.qvalue_objective)
    )
    assert walked == pytest.approx(actor / period + critic, rel=0.01)
