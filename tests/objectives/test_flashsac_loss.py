"""BatchNorm modes, gradients, groups, masks and discounts of `FlashSACLoss`."""

import pytest
import torch

from flashdex.modules.critic import EnsembleCritic
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.reward_normalizer import RewardNormalizer
from flashdex.objectives.terms import own_action_views

NETWORKS = ("actor_network", "qvalue_network", "target_qvalue_network")


def _statistics(loss):
    return {
        name: {
            k: v.clone()
            for k, v in getattr(loss, name).state_dict().items()
            if "running" in k
        }
        for name in NETWORKS
    }


def _moved(loss, before):
    """Networks all of whose running statistics moved; none may move in part."""
    result = set()
    for name, old in before.items():
        new = getattr(loss, name).state_dict()
        changed = {not torch.equal(new[k], v) for k, v in old.items()}
        assert len(changed) == 1, f"{name}: only a part of the statistics moved"
        if changed.pop():
            result.add(name)
    return result


@pytest.mark.parametrize("groups", [None, ("left", "right")], ids=["one", "two"])
def test_batch_norm_mode_table(make_loss, make_batch, groups):
    loss, td = make_loss(groups, future=True), make_batch(groups)
    before = _statistics(loss)
    loss.actor_loss(td)
    assert _moved(loss, before) == {"actor_network"}
    before = _statistics(loss)
    loss.qvalue_loss(td)
    assert _moved(loss, before) == {"qvalue_network", "target_qvalue_network"}


def test_statistics_see_both_halves(make_loss, make_batch):
    """The first running means are 0.01 times the mean over s and s' together."""
    loss, td = make_loss(None), make_batch(None)
    both = torch.cat([td["observation"], td["next", "observation"]])
    loss.actor_loss(td)
    loss.qvalue_loss(td)
    for name in NETWORKS:
        mean = getattr(loss, name).trunk.embed.norm.running_mean[:, :5]
        assert torch.allclose(mean, 0.01 * both.mean(0).expand_as(mean), atol=1e-6)
    action = loss.qvalue_network.trunk.embed.norm.running_mean[0, 5:]
    assert not torch.allclose(action, 0.01 * td["action"].mean(0), atol=1e-5)


@pytest.mark.parametrize("future", [False, True])
def test_gradients_only_where_they_belong(make_loss, make_batch, future):
    loss, td = make_loss(future=future), make_batch()
    loss.actor_loss(td)[0].backward()
    assert all(p.grad is not None for p in loss.actor_network.parameters())
    assert all(p.grad is None for p in loss.qvalue_network.parameters())
    assert loss.log_alpha.grad is None
    loss.zero_grad()
    loss.qvalue_loss(td)[0].backward()
    assert all(p.grad is not None for p in loss.qvalue_network.parameters())
    assert all(p.grad is None for p in loss.actor_network.parameters())
    assert all(p.grad is None for p in loss.target_qvalue_network.parameters())
    assert loss.log_alpha.grad is None


def test_alpha_loss_moves_towards_the_target_entropy(make_loss):
    loss = make_loss()
    log_prob = torch.stack([torch.full((8,), 3.0), torch.full((8,), -3.0)])
    value, metrics = loss.alpha_loss(log_prob)
    excess = torch.tensor([-3.0, 3.0]) - loss.target_entropy
    assert torch.allclose(metrics["loss_alpha"], 0.01 * excess)
    value.backward()
    assert torch.allclose(loss.log_alpha.grad, 0.01 * excess)


def test_trained_parameters_leave_out_the_target(make_loss):
    loss = make_loss()
    trained = {id(p) for p in loss.parameters()}
    assert not trained & {id(p) for p in loss.target_qvalue_network.parameters()}
    assert {id(p) for p in loss.qvalue_network.parameters()} <= trained
    assert any("target_qvalue_network" in k for k in loss.state_dict())


def test_actor_loss_gate(make_loss, make_batch):
    """A group's loss reaches its own tower only; its critic reads all actions."""
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    total, _ = loss.actor_loss(td, noise=noise)
    grads = torch.autograd.grad(total, list(loss.actor_network.parameters()))
    batch = loss.read(td)
    # oracle: tower h against critic h with the other action held constant
    for group in range(2):
        mean, std = loss.actor_network(batch.observation, mode="train")
        u = mean[:, :16] + std[:, :16] * noise
        action = u.tanh()
        other = action[1 - group].detach()
        parts = [action[0], other] if group == 0 else [other, action[1]]
        log_p = loss.qvalue_network(
            td["observation"], torch.cat(parts, -1), mode="eval"
        )
        value = loss.qvalue_network.expected_value(log_p)[group].amin(0)
        normal = torch.distributions.Normal(mean[:, :16], std[:, :16]).log_prob(u)
        log_pi = (normal - torch.log1p(-action.square() + 1e-12)).sum(-1)[group]
        own = (0.01 * log_pi - value).mean()
        oracle = torch.autograd.grad(own, list(loss.actor_network.parameters()))
        for found, wanted in zip(grads, oracle, strict=True):
            assert wanted[1 - group].abs().max() == 0
            assert torch.allclose(found[group], wanted[group], atol=2e-4, rtol=1e-2)


def test_action_views_gate_exactly():
    action = torch.rand(2, 6, 2, requires_grad=True)
    views = own_action_views(action)
    assert torch.equal(views[0], views[1])
    for group in range(2):
        (grad,) = torch.autograd.grad(views[group].sum(), action, retain_graph=True)
        assert torch.equal(grad[group], torch.ones(6, 2))
        assert torch.equal(grad[1 - group], torch.zeros(6, 2))


def _target(loss, td, noise):
    batch = loss.read(td)
    state = {k: v.clone() for k, v in loss.state_dict().items()}
    target, _ = loss.backup(batch, noise)
    loss.load_state_dict(state)
    return target


def test_target_of_a_group_ignores_the_other_alpha_and_reward(make_loss, make_batch):
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    before = _target(loss, td, noise)
    with torch.no_grad():
        loss.log_alpha[1] += 2.0
    td["next", "right", "reward"] *= 7.0
    after = _target(loss, td, noise)
    assert torch.equal(before[0], after[0])
    assert not torch.allclose(before[1], after[1])


def test_swapping_groups_permutes_the_metrics(make_loss, make_batch):
    loss, td = make_loss(), make_batch()
    swapped = make_loss(("right", "left"))
    order = torch.tensor([1, 0])
    critic = torch.tensor([2, 3, 0, 1])
    with torch.no_grad():
        for name, value in loss.actor_network.state_dict().items():
            swapped.actor_network.state_dict()[name].copy_(value[order])
        columns = torch.tensor([0, 1, 2, 3, 4, 7, 8, 5, 6])
        for net in ("qvalue_network", "target_qvalue_network"):
            for name, value in getattr(loss, net).state_dict().items():
                value = value[critic]
                if value.shape[-1] == 9:
                    value = value[..., columns]
                getattr(swapped, net).state_dict()[name].copy_(value)
    noise = torch.randn(2, 16, 2)
    for method in ("actor_loss", "qvalue_loss"):
        _, a = getattr(loss, method)(td, noise=noise)
        _, b = getattr(swapped, method)(td, noise=noise[order])
        for key, value in a.items():
            assert torch.allclose(value, b[key][order], atol=1e-5), key


def test_minimum_never_crosses_groups(make_loss, make_batch):
    """A group whose critics are far lower must not lower the other's target."""
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    before = _target(loss, td, noise)
    with torch.no_grad():
        loss.target_qvalue_network.head_bias[2:] -= torch.linspace(0, 30, 101)
    after = _target(loss, td, noise)
    assert torch.equal(before[0], after[0])
    atoms = loss.qvalue_network.atoms
    assert (after[1] @ atoms < before[1] @ atoms).any()


@pytest.mark.parametrize("exact", [True, False])
def test_discount_of_truncated_windows(make_loss, make_batch, exact):
    loss = make_loss(gamma=0.98, n_steps=5, exact_discount=exact)
    td = make_batch()
    default = torch.full((16,), 0.98**5)
    assert torch.allclose(loss.read(td).discount, default)
    steps = torch.arange(16) % 5 + 1
    td["steps"] = steps[:, None]
    wanted = 0.98 ** steps.float() if exact else default
    assert torch.allclose(loss.read(td).discount, wanted)


def test_terminated_is_read_and_truncated_is_not(make_loss, make_batch):
    loss, td = make_loss(gamma=0.9), make_batch()
    td["next", "terminated"] = torch.zeros(16, 1, dtype=torch.bool)
    td["next", "truncated"] = torch.ones(16, 1, dtype=torch.bool)
    td["next", "done"] = torch.ones(16, 1, dtype=torch.bool)
    noise = torch.randn(2, 16, 2)
    alive = _target(loss, td, noise)
    assert (alive > 1e-4).sum(-1).min() > 2
    td["next", "terminated"] = torch.ones(16, 1, dtype=torch.bool)
    dead = _target(loss, td, noise)
    assert (dead > 1e-4).sum(-1).max() <= 2
    mean = dead @ loss.qvalue_network.atoms
    rewards = torch.stack([td["next", g, "reward"][:, 0] for g in ("left", "right")])
    assert torch.allclose(mean, rewards.clamp(-5, 5), atol=1e-4)


def test_rewards_are_scaled_by_the_present_denominator(make_loss, make_batch):
    normalizer = RewardNormalizer(4, 2, gamma=0.9)
    loss, td = make_loss(reward_normalizer=normalizer), make_batch()
    for _ in range(3):
        reward = torch.randn(4, 2) * torch.tensor([1.0, 9.0])
        normalizer.update(reward, torch.zeros(4))
        wanted = td["next", "right", "reward"][:, 0] / normalizer.denominator()[1]
        assert torch.allclose(loss.read(td).reward[1], wanted)


def test_masked_rows_do_not_contribute(make_loss, make_batch):
    """Rows without a group leave its losses, yet stay in the batch statistics."""
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    mask = torch.ones(16, 2, dtype=torch.bool)
    mask[4:, 1] = False
    plain = {}
    for method in ("actor_loss", "qvalue_loss"):
        state = {k: v.clone() for k, v in loss.state_dict().items()}
        plain[method] = getattr(loss, method)(td, noise=noise)[1]
        full = td.clone().set("group_mask", torch.ones_like(mask))
        loss.load_state_dict(state)
        value = getattr(loss, method)(full, noise=noise)[1]
        for key, wanted in plain[method].items():
            assert torch.allclose(value[key], wanted, atol=1e-6), key
        loss.load_state_dict(state)
    td["group_mask"] = mask
    _, metrics = loss.qvalue_loss(td, noise=noise)
    assert torch.allclose(
        metrics["loss_qvalue"][0], plain["qvalue_loss"]["loss_qvalue"][0]
    )
    assert metrics["loss_qvalue"][1] != plain["qvalue_loss"]["loss_qvalue"][1]
    # an absent group's reward is never read
    td["next", "right", "reward"][4:] = 1e3
    state = {k: v.clone() for k, v in loss.state_dict().items()}
    first, _ = loss.qvalue_loss(td, noise=noise)
    loss.load_state_dict(state)
    td["next", "right", "reward"][4:] = -1e3
    second, _ = loss.qvalue_loss(td, noise=noise)
    assert torch.equal(first, second)


def test_masked_means_are_means_over_valid_rows(make_loss, make_batch):
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    td["group_mask"] = torch.rand(16, 2) > 0.5
    _, metrics = loss.actor_loss(td, noise=noise)
    for group in range(2):
        valid = metrics["log_prob"][group][td["group_mask"][:, group]]
        assert torch.allclose(metrics["entropy"][group], -valid.mean(), atol=1e-5)


def test_group_absent_from_the_whole_batch(make_loss, make_batch):
    loss, td = make_loss(), make_batch()
    td["group_mask"] = torch.tensor([True, False]).expand(16, 2)
    value, metrics = loss.actor_loss(td)
    value.backward()
    for name, parameter in loss.actor_network.named_parameters():
        assert parameter.grad[1].abs().max() == 0, name
    weight = loss.read(td).weight
    alpha, _ = loss.alpha_loss(metrics["log_prob"], weight)
    alpha.backward()
    assert loss.log_alpha.grad[1] == 0
    qvalue, _ = loss.qvalue_loss(td)
    qvalue.backward()
    assert loss.qvalue_network.head_bias.grad[2:].abs().max() == 0
    assert loss.qvalue_network.head_bias.grad[:2].abs().max() > 0


@pytest.mark.parametrize("critic_action", ["joint", "own"])
def test_batch_as_large_as_the_support(make_loss, make_batch, critic_action):
    """B = 101 = number of atoms: silent broadcasts would show as a wrong loss."""
    loss = make_loss(critic_action=critic_action)
    td = make_batch(size=101)
    noise = torch.randn(2, 101, 2)
    target = _target(loss, td, noise)
    assert target.shape == (2, 101, 101)
    assert torch.allclose(target.sum(-1), torch.ones(2, 101), atol=1e-5)
    value, metrics = loss.qvalue_loss(td, noise=noise)
    assert torch.allclose(value, metrics["loss_qvalue"].mean(), atol=1e-6)


def test_renamed_and_nested_keys(make_loss, make_batch):
    loss, td = make_loss(), make_batch()
    noise = torch.randn(2, 16, 2)
    state = {k: v.clone() for k, v in loss.state_dict().items()}
    wanted, _ = loss.qvalue_loss(td, noise=noise)
    loss.load_state_dict(state)
    loss.set_keys(observation=("sensors", "flat"), terminated="failed", reward="gain")
    for root in (td, td["next"]):
        root["sensors", "flat"] = root.pop("observation")
    td["next", "failed"] = td["next"].pop("terminated")
    for group in ("left", "right"):
        td["next", group, "gain"] = td["next", group].pop("reward")
    found, _ = loss.qvalue_loss(td, noise=noise)
    assert torch.equal(found, wanted)
    assert ("next", "left", "gain") in loss.in_keys
    assert ("next", "sensors", "flat") in loss.in_keys


def test_forward_returns_all_losses(make_loss, make_batch):
    loss, td = make_loss(future=True), make_batch()
    assert all(td.get(key, None) is not None for key in loss.in_keys)
    out = loss(td)
    total = sum(out[k] for k in ("loss_actor", "loss_alpha", "loss_qvalue"))
    total.backward()
    assert torch.isfinite(total)
    assert all(p.grad is not None for p in loss.parameters())


def test_group_counts_must_match(make_loss):
    actor = make_loss().actor_network
    with pytest.raises(ValueError, match="num_groups"):
        FlashSACLoss(actor, EnsembleCritic(5, 2), groups=("left", "right"))
