"""Held noise: distribution of the holds, clocks, resume; the policy around it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex.modules.actor import FlashActor
from flashdex.modules.exploration import NoiseRepetition, zeta_cdf
from flashdex.modules.policy import FlashPolicy


def test_zeta_table():
    mass = zeta_cdf().diff(prepend=torch.zeros(1))
    total = sum(k**-2 for k in range(1, 17))
    assert total == pytest.approx(1.584347, abs=1e-6)
    assert mass[0] == pytest.approx(1 / total)
    assert mass[15] == pytest.approx(0.0025, abs=5e-5)
    mean = (mass * torch.arange(1, 17)).sum()
    assert mean == pytest.approx(2.134, abs=5e-4)
    # a step starts a new hold with probability 1 / mean
    assert 1 - 1 / mean == pytest.approx(0.531, abs=5e-4)


@pytest.mark.parametrize("clock", ["shared", "per_env_hand"])
def test_hold_lengths(clock):
    torch.manual_seed(0)
    groups, envs, steps = (1, 1, 6000) if clock == "shared" else (2, 50, 120)
    noise = NoiseRepetition(clock=clock)
    draws = torch.stack([noise((groups, envs, 1)) for _ in range(steps)]).squeeze(-1)
    same = (draws[1:] == draws[:-1]).double().mean()
    assert same == pytest.approx(0.531, abs=0.025)
    lengths = []
    for series in draws.flatten(1).T:
        _, counts = torch.unique_consecutive(series, return_counts=True)
        lengths.append(counts[:-1])  # the last hold is cut off
    lengths = torch.cat(lengths).double()
    assert lengths.max() <= 16
    assert lengths.mean() == pytest.approx(2.134, abs=0.12)
    assert (lengths == 1).double().mean() == pytest.approx(0.631, abs=0.03)


def test_shared_clock_redraws_all_together():
    torch.manual_seed(1)
    noise = NoiseRepetition()
    draws = torch.stack([noise((2, 8, 3)) for _ in range(50)])
    same = (draws[1:] == draws[:-1]).flatten(1)
    assert torch.equal(same.all(1), same.any(1))
    own = NoiseRepetition(clock="per_env_hand")
    draws = torch.stack([own((2, 8, 3)) for _ in range(50)])
    same = (draws[1:] == draws[:-1]).all(-1).flatten(1)
    assert (same.any(1) & ~same.all(1)).any()


def test_other_batch_size_redraws():
    noise = NoiseRepetition()
    assert noise((2, 8, 3)).shape == (2, 8, 3)
    assert noise((2, 5, 3)).shape == (2, 5, 3)


@pytest.mark.parametrize("clock", ["shared", "per_env_hand"])
def test_a_state_of_the_other_clock_does_not_change_the_clock(clock):
    torch.manual_seed(2)
    other = "per_env_hand" if clock == "shared" else "shared"
    saved = NoiseRepetition(clock=other)
    saved((2, 8, 3))
    noise = NoiseRepetition(clock=clock)
    noise.load_state_dict(saved.state_dict())
    draws = torch.stack([noise((2, 8, 3)) for _ in range(50)])
    same = (draws[1:] == draws[:-1]).all(-1).flatten(1)
    together = torch.equal(same.all(1), same.any(1))
    assert together == (clock == "shared")


def test_resume_is_exact():
    generator = torch.Generator().manual_seed(3)
    noise = NoiseRepetition(generator=generator)
    for _ in range(5):
        noise((2, 4, 3))
    state, random = noise.state_dict(), generator.get_state()
    state = {k: v.clone() for k, v in state.items()}
    wanted = [noise((2, 4, 3)) for _ in range(10)]
    other = NoiseRepetition(generator=torch.Generator())
    other.load_state_dict(state)
    other.generator.set_state(random)
    for expected in wanted:
        assert torch.equal(other((2, 4, 3)), expected)


def test_policy_writes_both_groups_and_evaluates_quietly():
    torch.manual_seed(4)
    actor = FlashActor(5, 3, num_groups=2, width=8)
    policy = FlashPolicy(actor, groups=("left", "right"))
    td = TensorDict({"observation": torch.randn(7, 5)}, [7])
    before = {k: v.clone() for k, v in actor.state_dict().items()}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = policy(td.clone())
    mean, _ = actor(td["observation"], mode="eval")
    assert torch.allclose(out["left", "action"], mean[0].tanh())
    assert torch.allclose(out["right", "action"], mean[1].tanh())
    assert policy.noise.noise.numel() == 0
    with set_exploration_type(ExplorationType.RANDOM):
        noisy = policy(td.clone())
    assert not torch.allclose(noisy["left", "action"], mean[0].tanh())
    assert noisy["left", "action"].abs().max() <= 1
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_policy_without_groups_and_with_deep_batch():
    policy = FlashPolicy(FlashActor(5, 3, width=8))
    td = TensorDict({"observation": torch.randn(2, 4, 5)}, [2, 4])
    assert policy(td)["action"].shape == (2, 4, 3)
