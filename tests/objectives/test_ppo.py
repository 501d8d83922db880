"""PPO against brute force, the plain policy gradient, and tasks with a known score."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal
from torchrl.envs import PendulumEnv
from torchrl.envs.utils import step_mdp

from flashdex.modules.gaussian_policy import GaussianPolicy, ValueNet
from flashdex.objectives.ppo import (
    METRICS,
    PPO,
    bootstrap_rows,
    sampled_kl,
    steered_rate,
)

GAMMA, LAMBDA = 0.9, 0.8
WORLDS, STEPS, WIDTH, ACTIONS = 6, 9, 4, 3


def make_ppo(width=WIDTH, actions=ACTIONS, seed=0, **options):
    torch.manual_seed(seed)
    std = options.pop("init_std", 0.5)
    options = {"gamma": GAMMA, "gae_lambda": LAMBDA, **options}
    return PPO(
        GaussianPolicy(width, actions, hidden=[16, 16], init_std=std),
        ValueNet(width, hidden=[16, 16]),
        generator=torch.Generator().manual_seed(seed),
        **options,
    )


@pytest.fixture
def episode_rows():
    """A rollout with both kinds of ends, its tail, and every true next observation."""
    torch.manual_seed(1)
    observation = torch.randn(WORLDS, STEPS, WIDTH)
    done = torch.rand(WORLDS, STEPS) < 0.3
    done[0] = False
    terminated = done & (torch.rand(WORLDS, STEPS) < 0.5)
    assert terminated.any()
    assert (done & ~terminated).any()
    after = torch.cat([observation[:, 1:], torch.randn(WORLDS, 1, WIDTH)], 1)
    # an ended row is followed by a reset: its own next state stands nowhere else
    after = torch.where(done[..., None], torch.randn_like(after), after)
    rows = TensorDict(
        {
            "observation": observation,
            "action": torch.randn(WORLDS, STEPS, ACTIONS),
            "mask": torch.ones(WORLDS, STEPS, 1, dtype=torch.bool),
            "next": {
                "reward": torch.randn(WORLDS, STEPS, 1),
                "done": done[..., None],
                "terminated": terminated[..., None],
            },
        },
        [WORLDS, STEPS],
    )
    tail = TensorDict({"observation": after[bootstrap_rows(done)]})
    return rows, tail.auto_batch_size_(1), after


def weights(ppo):
    return [p.detach().clone() for p in ppo.parameters]


def test_advantages_equal_the_double_loop(episode_rows):
    rows, tail, after = episode_rows
    ppo = make_ppo()
    with torch.no_grad():
        value = ppo.value(rows["observation"]).squeeze(-1)
        following = ppo.value(after).squeeze(-1)
    reward, done, terminated = (
        rows["next", k].squeeze(-1) for k in ("reward", "done", "terminated")
    )
    expected = torch.zeros(WORLDS, STEPS)
    for world in range(WORLDS):
        for start in range(STEPS):
            for t in range(start, STEPS):
                bootstrap = 0.0 if terminated[world, t] else following[world, t]
                delta = reward[world, t] + GAMMA * bootstrap - value[world, t]
                expected[world, start] += (GAMMA * LAMBDA) ** (t - start) * delta
                if done[world, t]:
                    break
    out = ppo.estimate(rows, tail)
    torch.testing.assert_close(out["advantage"].squeeze(-1), expected)
    torch.testing.assert_close(out["value_target"].squeeze(-1), expected + value)


def test_first_minibatch_is_the_plain_policy_gradient(episode_rows):
    rows, tail, _ = episode_rows
    ppo = make_ppo()
    batch = ppo.estimate(rows, tail).reshape(-1)
    out = ppo.loss(batch)
    torch.testing.assert_close(out["mean_ratio"], torch.tensor(1.0))
    torch.testing.assert_close(out["max_ratio"], torch.tensor(1.0))
    assert out["clip_fraction"] == 0
    names = list(ppo.policy.parameters())
    ours = torch.autograd.grad(out["loss_objective"], names)
    mean, std = ppo.policy(batch["observation"])
    log_prob = Normal(mean, std).log_prob(batch["action"]).sum(-1)
    plain = -(log_prob * batch["advantage"].squeeze(-1)).mean()
    theirs = torch.autograd.grad(plain, names)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)
    mse = (ppo.value(batch["observation"]) - batch["value_target"]).square().mean()
    torch.testing.assert_close(out["loss_critic"], mse)
    normal = 0.5 * math.log(2 * math.pi * math.e) + math.log(0.5)
    torch.testing.assert_close(out["entropy"], torch.tensor(ACTIONS * normal))


@pytest.mark.parametrize("options", [{}, {"value_clip": 0.2, "target_kl": 0.01}])
def test_masked_worlds_change_nothing(episode_rows, options):
    rows, tail, _ = episode_rows
    rows["mask"][::2] = False
    spoilt, spoilt_tail = rows.clone(), tail.clone()
    spoilt["action"][::2] = float("nan")
    spoilt["next", "reward"][::2] = float("nan")
    one, two = make_ppo(**options), make_ppo(**options)
    a, b = one.learn(rows, tail), two.learn(spoilt, spoilt_tail)
    assert all(torch.equal(a[k], b[k]) for k in (*METRICS, "std", "learning_rate"))
    assert all(map(torch.equal, weights(one), weights(two)))
    assert not any(map(torch.equal, weights(one), weights(make_ppo(**options))))


def test_nothing_is_learnt_where_no_row_counts(episode_rows):
    rows, tail, _ = episode_rows
    rows["mask"][:] = False
    ppo = make_ppo()
    before = weights(ppo)
    report = ppo.learn(rows, tail)
    assert set(report.keys()) == {*METRICS, "std", "learning_rate"}
    assert all(report[k] == 0 for k in METRICS)
    assert all(map(torch.equal, weights(ppo), before))


@pytest.mark.parametrize(("given", "expected"), [(3e-4, 7e-5), (1e-5, 1e-5)])
def test_a_resumed_rate_goes_on_unless_another_one_is_given(given, expected):
    one, two = make_ppo(lr=3e-4), make_ppo(lr=given)
    one.rate.fill_(7e-5)  # as steered by the divergence
    state = one.state_dict()
    two.load_state_dict(state)
    assert two.rate.item() == pytest.approx(expected)
    assert one.rate.item() == pytest.approx(7e-5)
    # what is stored next belongs to the rate that was given
    three = make_ppo(lr=given)
    three.load_state_dict(two.state_dict())
    assert three.rate.item() == pytest.approx(expected)
    # and the steps are taken at it: Adam's step is linear in its rate
    for ppo in (one, two):
        for parameter in ppo.parameters:
            parameter.grad = torch.ones_like(parameter)
    before = [ppo.parameters[0].detach().clone() for ppo in (one, two)]
    for ppo in (one, two):
        ppo.optimizer.step()
    moved = [
        (ppo.parameters[0].detach() - b).abs().mean()
        for ppo, b in zip((one, two), before, strict=True)
    ]
    assert (moved[1] / moved[0]).item() == pytest.approx(expected / 7e-5, rel=1e-2)


def test_rate_follows_the_divergence():
    rate = torch.tensor(1e-3)
    found = [steered_rate(rate, torch.tensor(k), 0.01) for k in (0.021, 0.01, 0.004)]
    expected = [1e-3 / 1.5, 1e-3, 1.5e-3]
    assert [f.item() for f in found] == pytest.approx(expected)
    assert steered_rate(torch.tensor(1e-2), torch.tensor(0.0), 0.01) == 1e-2
    assert steered_rate(torch.tensor(1e-6), torch.tensor(1.0), 0.01) == 1e-6


def test_sampled_divergence_is_that_of_the_gaussians():
    ppo = make_ppo()
    rows, tail = policy_rows(ppo, torch.randn(20_000, WIDTH))
    batch = ppo.estimate(rows, tail).reshape(-1)
    old = Normal(*(x.detach() for x in ppo.policy(batch["observation"])))
    with torch.no_grad():
        for p in ppo.policy.parameters():
            p.add_(0.03 * torch.randn(p.shape, generator=ppo.generator))
        new = Normal(*ppo.policy(batch["observation"]))
    true = torch.distributions.kl_divergence(old, new).sum(-1).mean().item()
    assert 0.001 < true < 0.02
    assert sampled_kl(ppo.loss(batch)).item() == pytest.approx(true, rel=0.05)


def policy_rows(ppo, observation):
    """Rows of the policy's own actions, one step an episode, and their tail."""
    seen = TensorDict({"observation": observation}, observation.shape[:1])
    ends = torch.ones(len(observation), 1, dtype=torch.bool)
    after = {"reward": torch.zeros(ends.shape), "done": ends, "terminated": ends}
    rows = seen.clone().set("action", ppo.act(seen, explore=True)).set("mask", ends)
    rows.set("next", TensorDict(after, seen.batch_size))
    return rows.unsqueeze(1), seen


def test_a_bandit_is_learnt():
    """Reward -(a - s)^2 for the sign s that is shown: the best action is s."""
    ppo = make_ppo(1, 1, target_kl=0.02)
    signs = TensorDict({"observation": torch.tensor([[-1.0], [1.0]])}, [2])
    assert ppo.act(signs, explore=False).abs().max() < 0.1
    for _ in range(60):
        rows, tail = policy_rows(ppo, torch.randn(64, 1).sign())
        rows["next", "reward"] = -(rows["action"] - rows["observation"]).square()
        ppo.learn(rows, tail)
    assert (ppo.act(signs, explore=False) - signs["observation"]).abs().max() < 0.1
    assert ppo.policy.log_std.exp() < 0.3


PENDULUMS, HORIZON, EPISODE, MAX_TORQUE = 64, 50, 100, 2.0


def show(td):
    angle, speed = td["th"], td["thdot"]
    return torch.stack([angle.sin(), angle.cos(), speed / 8.0], -1)


def new_pendulums(env):
    return env.reset(env.gen_params(batch_size=[PENDULUMS]), set_state=False)


def swing(env, ppo, td, steps, *, explore):
    """Step all pendulums; return what came next, the rows and their tail."""
    rows = []
    for _ in range(steps):
        seen = TensorDict({"observation": show(td)}, [PENDULUMS])
        action = ppo.act(seen, explore=explore)
        td = env.step(td.set("action", MAX_TORQUE * action.clamp(-1, 1)))
        no = torch.zeros(PENDULUMS, 1, dtype=torch.bool)
        after = {"reward": td["next", "reward"] / 20, "done": no, "terminated": no}
        row = seen.set("action", action).set("mask", ~no)
        rows.append(row.set("next", TensorDict(after, [PENDULUMS])))
        td = step_mdp(td)
    rollout = torch.stack(rows, 1)
    # time-outs are no ends of the pendulum: the last row always bootstraps
    tail = TensorDict({"observation": show(td)}, [PENDULUMS])
    return td, rollout, tail


def mean_return(env, ppo):
    env.set_seed(7)
    _, rollout, _ = swing(env, ppo, new_pendulums(env), EPISODE, explore=False)
    return 20 * rollout["next", "reward"].sum(1).mean().item()


@pytest.mark.learn
def test_pendulum_is_learnt():
    """Swing-up from any angle: untrained about -540, solved about -120."""
    env = PendulumEnv(seed=0)
    ppo = make_ppo(
        3, 1, gamma=0.97, gae_lambda=0.95, target_kl=0.015, init_std=0.7, epochs=10
    )
    first = mean_return(env, ppo)
    for i in range(150):
        if i % (EPISODE // HORIZON) == 0:
            td = new_pendulums(env)
        td, rollout, tail = swing(env, ppo, td, HORIZON, explore=True)
        ppo.learn(rollout, tail)
    last = mean_return(env, ppo)
    assert last > 0.35 * first, (first, last)
