"""Held noise: the whole histogram of hold lengths, and who may move the clocks."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flashdex.modules.actor import FlashActor
from flashdex.modules.exploration import NoiseRepetition
from flashdex.modules.policy import FlashPolicy

MAXIMUM = 16


def test_histogram_of_hold_lengths():
    """20,000 first holds against ``k^-2 / sum j^-2``; standard errors below 0.35 %."""
    envs = 10_000
    noise = NoiseRepetition(
        clock="per_env_hand", generator=torch.Generator().manual_seed(0)
    )
    draws = torch.stack([noise((2, envs, 1)) for _ in range(MAXIMUM + 1)])
    # a hold that starts at step 0 lasts until the value first differs
    held = (draws == draws[0]).squeeze(-1).long().cumprod(0).sum(0).flatten()
    found = torch.bincount(held, minlength=MAXIMUM + 1)[1:] / held.numel()
    mass = torch.tensor([k**-2.0 for k in range(1, MAXIMUM + 1)])
    wanted = mass / mass.sum()
    error = (wanted * (1 - wanted) / held.numel()).sqrt()
    assert held.max() == MAXIMUM
    assert ((found - wanted).abs() < 4 * error).all()
    assert held.double().mean() == pytest.approx(2.134, abs=0.065)


def test_shared_holds_in_sequence():
    """Later holds follow the same law: mean of 2,000 in a row, all worlds together."""
    noise = NoiseRepetition(generator=torch.Generator().manual_seed(1))
    series = torch.stack([noise((1, 2, 1)) for _ in range(4300)])[:, 0, :, 0]
    holds = [torch.unique_consecutive(x, return_counts=True)[1] for x in series.T]
    assert torch.equal(holds[0], holds[1])
    assert holds[0][:-1].double().mean() == pytest.approx(2.134, abs=0.2)


def _policy(seed=0):
    torch.manual_seed(seed)
    noise = NoiseRepetition(generator=torch.Generator().manual_seed(seed))
    actor = FlashActor(5, 3, num_groups=2, width=8)
    return FlashPolicy(actor, groups=("left", "right"), noise=noise)


def _act(policy, td, kind):
    with set_exploration_type(kind):
        return policy(td.clone())["left", "action"]


@pytest.mark.parametrize("eval_envs", [6, 9], ids=["same size", "other size"])
def test_evaluation_in_between_leaves_exploration_as_it_was(eval_envs):
    """Same noisy actions with and without evaluations between them."""
    rows = torch.randn(20, 6, 5, generator=torch.Generator().manual_seed(3))
    tds = [TensorDict({"observation": row}, [6]) for row in rows]
    quiet, busy = _policy(), _policy()
    other = TensorDict({"observation": torch.randn(eval_envs, 5)}, [eval_envs])
    for td in tds:
        wanted = _act(quiet, td, ExplorationType.RANDOM)
        before = {k: v.clone() for k, v in busy.noise.state_dict().items()}
        calm = _act(busy, other, ExplorationType.DETERMINISTIC)
        for name, value in busy.noise.state_dict().items():
            assert torch.equal(value, before[name]), name
        mean, _ = busy.actor(other["observation"], mode="eval")
        assert torch.equal(calm, mean[0].tanh())
        assert torch.equal(_act(busy, td, ExplorationType.RANDOM), wanted)


def test_the_noise_is_held_and_not_the_action():
    """Within a hold a = tanh(mean(s) + std(s) eps) follows the observation."""
    policy = _policy()
    with torch.no_grad():
        policy.actor.head.weight.normal_()
    repeated = 0
    for _ in range(40):
        before = policy.noise.noise.clone()
        td = TensorDict({"observation": torch.randn(6, 5)}, [6])
        action = _act(policy, td, ExplorationType.RANDOM)
        eps = policy.noise.noise
        mean, std = policy.actor(td["observation"], mode="eval")
        assert torch.allclose(action, (mean + std * eps)[0].tanh(), atol=1e-6)
        repeated += int(eps.shape == before.shape and torch.equal(eps, before))
    assert 8 < repeated < 34
