"""Updates: order, projection, target average, schedules, masks of time, resume."""

import math

import pytest
import torch
from torch._dynamo.utils import counters

from flashdex.modules.layers import UnitBatchNorm, UnitLinear, UnitRMSNorm
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.stepper import FlashSACStepper, cosine_rate


def _assert_projected(network):
    for layer in network.modules():
        if isinstance(layer, UnitLinear):
            norm = layer.weight.norm(dim=-1)
            assert torch.allclose(norm, torch.ones_like(norm), atol=1e-5)
        elif isinstance(layer, UnitBatchNorm):
            square = layer.weight.square().sum(-1) + layer.bias.square().sum(-1)
            wanted = torch.full_like(square, layer.weight.shape[-1])
            assert torch.allclose(square, wanted, rtol=1e-5)
        elif isinstance(layer, UnitRMSNorm):
            square = layer.weight.square().sum(-1)
            wanted = torch.full_like(square, layer.weight.shape[-1])
            assert torch.allclose(square, wanted, rtol=1e-5)


def test_every_layer_is_projected_after_each_update(make_loss, make_batch):
    loss = make_loss(future=True)
    stepper = FlashSACStepper(loss, lr=3e-2)
    for seed in range(3):
        before = loss.actor_network.head.weight.clone()
        stepper.update(make_batch(seed=seed))
        _assert_projected(loss.actor_network)
        _assert_projected(loss.qvalue_network)
        moved = not torch.equal(before, loss.actor_network.head.weight)
        assert moved == (seed % 2 == 0)


def test_target_average_touches_parameters_only(make_loss, make_batch):
    loss = make_loss()
    stepper = FlashSACStepper(loss, tau=0.1, lr=1e-2)
    target, online = loss.target_qvalue_network, loss.qvalue_network
    old = {k: v.clone() for k, v in target.state_dict().items()}
    stepper.update(make_batch())
    # after one update both hold the same statistics: same weights, same batch
    online = online.state_dict()
    for name, value in target.state_dict().items():
        if "running" not in name:
            wanted = old[name] + 0.1 * (online[name] - old[name])
            assert torch.allclose(value, wanted, atol=1e-6), name
    before = {k: v.clone() for k, v in target.state_dict().items() if "running" in k}
    stepper.average_target()
    for name, value in before.items():
        assert torch.equal(target.state_dict()[name], value), name
    stepper.update(make_batch(seed=1))
    for name in before:
        assert torch.equal(target.state_dict()[name], online[name]) == (
            "embed" in name
        ), name


def test_critic_target_sees_the_stepped_actor_and_alpha(make_loss, make_batch):
    """The critic loss of an update equals the one evaluated after its actor step."""
    torch.manual_seed(0)
    loss, td = make_loss(), make_batch()
    actor_noise, target_noise = torch.randn(2, 16, 2), torch.randn(2, 16, 2)
    stepper = FlashSACStepper(loss, lr=1e-2)
    state = {k: v.clone() for k, v in loss.state_dict().items()}
    report = stepper.update(td, actor_noise=actor_noise, target_noise=target_noise)
    after = {k: v.clone() for k, v in loss.state_dict().items()}
    # actor and temperature of after, critics of before
    mixed = {
        k: after[k] if k.startswith(("actor_network", "log_alpha")) else state[k]
        for k in state
    }
    loss.load_state_dict(mixed)
    _, metrics = loss.qvalue_loss(td, noise=target_noise)
    found = torch.stack([report[g, "loss_qvalue"] for g in ("left", "right")])
    assert torch.allclose(found, metrics["loss_qvalue"], atol=1e-6)
    loss.load_state_dict(state)
    _, stale = loss.qvalue_loss(td, noise=target_noise)
    assert not torch.allclose(found, stale["loss_qvalue"], atol=1e-6)


def test_cosine_schedule():
    def rate(step):
        return cosine_rate(step, 100, peak=3e-4, end=1.5e-4)

    assert rate(0) == 3e-4
    assert rate(50) == pytest.approx(2.25e-4)
    assert rate(100) == rate(170) == pytest.approx(1.5e-4)
    wanted = 1.5e-4 + 0.75e-4 * (1 + math.cos(math.pi * 0.3))
    assert rate(30) == pytest.approx(wanted)
    assert cosine_rate(9999, None, peak=3e-4, end=1.5e-4) == 3e-4


def test_each_optimiser_counts_its_own_steps(make_loss, make_batch):
    stepper = FlashSACStepper(make_loss(), total_updates=10)
    for _ in range(10):
        stepper.update(make_batch())
    assert stepper.critic_optimizer.rate == pytest.approx(1.5e-4)
    assert stepper.actor_optimizer.rate == pytest.approx(2.25e-4)
    assert stepper.alpha_optimizer.rate == pytest.approx(2.25e-4)


def test_metrics_are_detached_and_always_the_same(make_loss, make_batch):
    stepper = FlashSACStepper(make_loss(future=True))
    reports = [stepper.update(make_batch(seed=s)) for s in range(3)]
    keys = set(reports[0].keys(True, True))
    assert {("left", "loss_actor"), ("right", "alpha"), "learning_rate"} <= keys
    for report in reports:
        assert set(report.keys(True, True)) == keys
        for value in report.values(True, True):
            assert value.shape == ()
            assert not value.requires_grad
    assert reports[1]["left", "entropy"] == reports[0]["left", "entropy"]
    assert reports[2]["left", "entropy"] != reports[0]["left", "entropy"]


def test_mask_and_steps_pass_through_the_stepper(make_loss, make_batch):
    td = make_batch()
    td["group_mask"] = torch.tensor([True, False]).expand(16, 2)
    td["steps"] = torch.full((16, 1), 3)
    loss = make_loss()
    right = loss.actor_network.head.weight[1].clone()
    FlashSACStepper(loss).update(td)
    # projection of an already projected row moves it by rounding at most
    assert torch.allclose(loss.actor_network.head.weight[1], right, atol=1e-6)


def _equal(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(_equal, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_resume_is_bit_equal(make_loss, make_batch, tmp_path):
    def fresh(seed):
        torch.manual_seed(seed)
        normalizer = RewardNormalizer(4, 2, gamma=0.9)
        loss = make_loss(future=True, reward_normalizer=normalizer)
        generator = torch.Generator().manual_seed(seed)
        return FlashSACStepper(loss, total_updates=50, generator=generator)

    def advance(stepper, start, stop):
        for i in range(start, stop):
            reward = torch.randn(4, 2, generator=torch.Generator().manual_seed(i))
            stepper.loss.reward_normalizer.update(reward, torch.zeros(4))
            report = stepper.update(make_batch(seed=i))
        return report

    first = fresh(0)
    advance(first, 0, 3)
    torch.save(first.state_dict(), tmp_path / "learner.pt")
    wanted = advance(first, 3, 8)
    second = fresh(1)
    second.load_state_dict(torch.load(tmp_path / "learner.pt"))
    found = advance(second, 3, 8)
    assert (wanted == found).all()
    assert _equal(first.state_dict(), second.state_dict())


def test_same_seed_same_run(make_loss, make_batch):
    reports = []
    for _ in range(2):
        torch.manual_seed(5)
        stepper = FlashSACStepper(make_loss(), generator=torch.Generator())
        reports.append([stepper.update(make_batch(seed=i)) for i in range(4)][-1])
    assert (reports[0] == reports[1]).all()


@pytest.mark.slow
def test_compiled_equals_eager(make_loss, make_batch):
    """Same updates with and without the compiler; each objective is one graph."""
    # double: Adam turns the sign of a rounding error into a full first step
    losses = [make_loss(future=True).double() for _ in range(2)]
    losses[1].load_state_dict(losses[0].state_dict())
    torch.compiler.reset()
    counters.clear()
    eager, compiled = (
        FlashSACStepper(loss, compile=flag)
        for loss, flag in zip(losses, (False, True), strict=True)
    )
    for seed in range(4):
        noise = {
            name: torch.randn(2, 16, 2, dtype=torch.float64)
            for name in ("actor_noise", "target_noise")
        }
        td = make_batch(seed=seed)
        td = td.apply(lambda x: x.double() if x.is_floating_point() else x)
        a, b = eager.update(td, **noise), compiled.update(td, **noise)
        for key in a.keys(True, True):
            assert torch.allclose(a[key], b[key], atol=1e-9), (seed, key)
    assert counters["stats"]["unique_graphs"] == 2
    assert not counters["graph_break"]
