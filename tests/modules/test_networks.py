"""Actor, critic and future encoder: sizes, heads, independence of members."""

import math

import pytest
import torch
from torch import nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.modules.policy import sample_squashed, target_entropy


def _count(module):
    return sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize(
    ("obs", "act", "critic", "actor"),
    [(17, 6, 2_171_686, 268_590), (300, 50, 2_340_418, 316_732)],
)
def test_parameter_counts(obs, act, critic, actor):
    assert _count(EnsembleCritic(obs, act)) == critic
    assert _count(FlashActor(obs, act, head="unit")) == actor
    assert _count(FlashActor(obs, act, head="centred")) == actor


def test_wide_critic_parameter_count():
    assert _count(EnsembleCritic(300, 50, width=1024)) == 34_522_690


def test_future_encoder_size():
    encoder = FutureEncoder(78)
    assert _count(encoder) == 59_488
    assert encoder(torch.randn(5, 78, 10)).shape == (1, 5, 128)


@pytest.mark.parametrize("num_frames", [6, 10, 13])
def test_future_encoder_equals_convolutions(num_frames):
    torch.manual_seed(0)
    encoder = FutureEncoder(7, num_frames=num_frames, latent_dim=9, ensemble=2)
    future = torch.randn(4, 7, num_frames)
    out = encoder(future)
    for e in range(2):
        x = future
        for i, (kernel, stride) in enumerate([(1, 1), (4, 2), (2, 1)]):
            width = encoder.weights[i].shape[1]
            conv = nn.Conv1d(x.shape[1], width, kernel, stride)
            weight = encoder.weights[i][e].reshape(width, -1, kernel)
            conv.weight.data, conv.bias.data = weight, encoder.biases[i][e]
            x = nn.functional.silu(conv(x))
        flat = x.mT.flatten(1)  # frame-major
        expected = flat @ encoder.weights[3][e].T + encoder.biases[3][e]
        assert torch.allclose(out[e], expected, atol=1e-5)


def test_centred_head_starts_on_the_reference():
    torch.manual_seed(0)
    actor = FlashActor(9, 4, num_groups=2)
    mean, std = actor(torch.randn(64, 9), mode="train")
    assert mean.abs().max() < 0.1
    assert torch.allclose(std, torch.full_like(std, math.exp(-2.5)))
    wide = FlashActor(9, 4, init_std=0.3)
    _, std = wide(torch.randn(8, 9), mode="eval")
    assert torch.allclose(std, torch.full_like(std, 0.3))
    with pytest.raises(ValueError, match="init_std"):
        FlashActor(9, 4, init_std=2.0)


@pytest.mark.parametrize("head", ["centred", "unit"])
def test_log_std_range(head):
    actor = FlashActor(3, 2, head=head, width=8)
    low, high = {"centred": (-5, 0), "unit": (-10, 2)}[head]
    for sign, bound in [(-1, low), (1, high)]:
        with torch.no_grad():
            actor.head_bias.fill_(sign * 100.0)
        _, std = actor(torch.randn(5, 3), mode="eval")
        assert torch.allclose(std.log(), torch.full_like(std, bound), atol=1e-4)


def test_unit_head_is_projected_and_plain_head_is_not():
    from flashdex.modules.layers import project_

    for head, unit in [("unit", True), ("centred", False)]:
        actor = FlashActor(3, 2, head=head, width=8)
        with torch.no_grad():
            actor.head.weight.fill_(3.0)
        project_(actor)
        norm = actor.head.weight.norm(dim=-1)
        assert torch.allclose(norm, torch.ones_like(norm)) == unit


def test_towers_are_disjoint():
    """A tower of the stack equals the same tower alone; gradients do not cross."""
    torch.manual_seed(1)
    pair = FlashActor(
        5, 3, num_groups=2, width=8, future_encoder=FutureEncoder(4, ensemble=2)
    )
    alone = FlashActor(5, 3, width=8, future_encoder=FutureEncoder(4))
    alone.load_state_dict({k: v[1:] for k, v in pair.state_dict().items()})
    obs, future = torch.randn(6, 5), torch.randn(6, 4, 10)
    mean, std = pair(obs, future, mode="train")
    mean1, std1 = alone(obs, future, mode="train")
    assert torch.allclose(mean[1], mean1[0], atol=1e-6)
    assert torch.allclose(std[1], std1[0], atol=1e-6)
    (mean[0].sum() + std[0].sum()).backward()
    for name, parameter in pair.named_parameters():
        assert parameter.grad[1].abs().max() == 0, name


def test_critic_is_a_distribution_with_group_member_layout():
    torch.manual_seed(2)
    critic = EnsembleCritic(5, 3, num_groups=2, num_members=2, width=8)
    obs, action = torch.randn(6, 5), torch.rand(6, 6)
    log_p = critic(obs, action, mode="eval")
    assert log_p.shape == (2, 2, 6, 101)
    assert torch.allclose(log_p.exp().sum(-1), torch.ones(2, 2, 6))
    value = critic.expected_value(log_p)
    loop = sum(log_p.exp()[..., i] * (-5 + 0.1 * i) for i in range(101))
    assert torch.allclose(value, loop, atol=1e-5)
    # members 2 and 3 of the ensemble belong to group 1
    with torch.no_grad():
        critic.head_bias[2:] += torch.linspace(0, 9, 101)
    shifted = critic.expected_value(critic(obs, action, mode="eval"))
    assert torch.allclose(shifted[0], value[0])
    assert (shifted[1] > value[1]).all()


def test_action_views_equal_the_joint_action():
    critic = EnsembleCritic(5, 3, num_groups=2, width=8)
    obs, action = torch.randn(6, 5), torch.rand(6, 6)
    views = action.expand(2, -1, -1)
    for mode in ("eval", "frozen"):
        plain = critic(obs, action, mode=mode)
        assert torch.allclose(plain, critic(obs, views, mode=mode), atol=1e-5)


def test_own_action_critic_ignores_the_other_group():
    critic = EnsembleCritic(5, 3, num_groups=2, width=8, critic_action="own")
    action = torch.rand(6, 6, requires_grad=True)
    log_p = critic(torch.randn(6, 5), action, mode="train")
    (grad,) = torch.autograd.grad(critic.expected_value(log_p)[0].sum(), action)
    assert torch.equal(grad[:, 3:], torch.zeros(6, 3))
    assert grad[:, :3].abs().sum() > 0


def test_squashed_density_matches_torch():
    torch.manual_seed(3)
    mean = torch.randn(2, 5, 3, dtype=torch.float64)
    std = torch.rand(2, 5, 3, dtype=torch.float64) + 0.1
    noise = torch.randn(2, 5, 3, dtype=torch.float64)
    action, log_prob = sample_squashed(mean, std, noise)
    u = mean + std * noise
    oracle = TransformedDistribution(Normal(mean, std), TanhTransform(cache_size=1))
    tanh = oracle.transforms[0]
    expected = Normal(mean, std).log_prob(u) - tanh.log_abs_det_jacobian(u, action)
    assert torch.allclose(action, torch.tanh(u))
    assert torch.allclose(log_prob, expected.sum(-1))


def test_density_is_finite_at_saturation():
    mean = torch.tensor([[40.0, -40.0]], requires_grad=True)
    action, log_prob = sample_squashed(mean, torch.ones(1, 2), torch.zeros(1, 2))
    log_prob.sum().backward()
    assert torch.isfinite(log_prob).all()
    assert torch.isfinite(mean.grad).all()
    assert torch.equal(action.abs(), torch.ones(1, 2))


def test_target_entropy():
    assert target_entropy(1) == pytest.approx(-0.47818145, abs=1e-8)
    assert target_entropy(18) == pytest.approx(-8.6073, abs=1e-4)
    assert target_entropy(28) == pytest.approx(-13.3891, abs=1e-4)
