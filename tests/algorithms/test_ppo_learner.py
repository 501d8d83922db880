"""The PPO learner on the environment, with tiny networks."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from flashdex import keys
from flashdex.algorithms.config import PPOConfig
from flashdex.envs.transforms.assembly import assemble
from flashdex.errors import RunError
from flashdex.recipe import MotionsConfig, TrainConfig
from flashdex.training.checkpoint import load_checkpoint, save_checkpoint

HORIZON, WORLDS, ATTEMPTS = 8, 6, 2
GROUPS = ("per_hand", "unified")


@pytest.fixture
def make_ppo(make_bench):
    """Make builder, environment and PPO learner; two of six worlds attempt."""

    def make(groups="per_hand", *, ppo=None, **env):
        sizes = {"horizon": HORIZON, "epochs": 2, "minibatches": 2, "hidden": [16]}
        config = PPOConfig(**{**sizes, **(ppo or {})})
        algo = {"kind": "ppo", "groups": groups, "ppo": config}
        env = {"attempt_share": ATTEMPTS / WORLDS, **env}
        bench = make_bench(WORLDS, algo=algo, **env)
        world = bench.make_env()
        return bench, world, bench.make_learner(world)

    return make


def parameters(learner):
    groups = learner.agents.values()
    return [p.detach().clone() for agent in groups for p in agent.parameters]


def all_equal(one, two):
    return all(map(torch.equal, parameters(one), parameters(two)))


def begin(env, learner, collect):
    """Collect the first rollout, which sets the input statistics."""
    td = collect(env, learner, HORIZON)
    assert learner.num_updates() == 0
    return td


@pytest.fixture
def watch():
    """Have a learner keep what it is told to remember, attempt worlds included."""

    def start(learner):
        told, remember = [], learner.process_step

        def keep(*args):
            told.append([a.clone() for a in args])
            remember(*args)

        learner.process_step = keep
        return told

    return start


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("future", [True, False])
def test_act_remember_update(make_ppo, collect, groups, future):
    env = {} if future else {"transforms": {"proprioception": {}, "object_state": {}}}
    _, env, learner = make_ppo(groups, **env)
    td = begin(env, learner, collect)
    names = {"left", "right"} if groups == "per_hand" else {"both"}
    reports = []
    for done in range(2):
        before = parameters(learner)
        td = collect(env, learner, HORIZON - 1, td)
        assert learner.num_updates() == 0
        td = collect(env, learner, 1, td)
        assert learner.num_updates() == 1
        assert learner.num_rows == HORIZON * (WORLDS - ATTEMPTS)
        reports.append(learner.update())
        assert learner.num_rows == 0
        assert learner.updates == done + 1
        assert not any(map(torch.equal, before, parameters(learner)))
    assert set(reports[0].keys()) == names
    first, second = (set(r.keys(True, True)) for r in reports)
    assert first == second
    assert all(torch.isfinite(v).all() for r in reports for v in r.values(True, True))


def test_first_rollout_only_sets_the_input_statistics(make_ppo, collect, watch):
    _, env, learner = make_ppo()
    told, before = watch(learner), parameters(learner)
    begin(env, learner, collect)
    assert all(map(torch.equal, before, parameters(learner)))
    assert learner.num_rows == 0
    seen = [assemble(learner.inputs.transforms, row[0])[ATTEMPTS:] for row in told]
    for key, axes in ((keys.OBSERVATION, 0), (keys.FUTURE, (0, 2))):
        rows = torch.cat([s[key] for s in seen]).double()
        torch.testing.assert_close(learner.inputs.norm(key).mean, rows.mean(axes))


def test_attempt_worlds_act_deterministically(make_ppo, collect):
    _, env, learner = make_ppo()
    td = begin(env, learner, collect)
    one, two = learner.act(td), learner.act(td)
    quiet = learner.act(td, explore=False)
    assert one.shape == (WORLDS, 2, env.joint_range.shape[1])
    assert torch.equal(one[:ATTEMPTS], two[:ATTEMPTS])
    assert torch.equal(one[:ATTEMPTS], quiet[:ATTEMPTS])
    assert not torch.equal(one[ATTEMPTS:], two[ATTEMPTS:])
    assert torch.equal(quiet, learner.act(td, explore=False))
    assert quiet.abs().max() <= 1


def test_advantages_equal_the_double_loop(make_ppo, collect, watch):
    """Through the environment: its own terminal states, resets and two hands."""
    steps = 25
    wild = {"horizon": steps, "init_std": 1.0}
    _, env, learner = make_ppo(ppo=wild, max_seconds=0.15)
    told = watch(learner)
    collect(env, learner, steps)
    batches, tail, _ = learner.batches()
    state, _, rewards, after, terminated, done = (
        torch.stack(part, 1)[ATTEMPTS:] for part in zip(*told, strict=True)
    )
    terminated, done = terminated.squeeze(-1), done.squeeze(-1)
    assert terminated.any()
    assert (done & ~terminated).any()
    scale = learner.normalizer.denominator()
    gamma, decay = learner.config.gamma, learner.config.ppo.gae_lambda
    shown, shown_after = (
        learner.inputs(s.select(*keys.STATE).reshape(-1)) for s in (state, after)
    )
    for i, (name, agent) in enumerate(learner.agents.items()):
        inputs = [[s[k] for k in learner.inputs.keys] for s in (shown, shown_after)]
        with torch.no_grad():
            before, following = (agent.value(*x).view(done.shape) for x in inputs)
        reward = rewards[..., i] / scale[i]
        expected = torch.zeros(done.shape)
        for world, start in torch.ones(done.shape).nonzero().tolist():
            for t in range(start, steps):
                bootstrap = following[world, t] * ~terminated[world, t]
                delta = reward[world, t] + gamma * bootstrap - before[world, t]
                expected[world, start] += (gamma * decay) ** (t - start) * delta
                if done[world, t]:
                    break
        found = agent.estimate(batches[name], tail)["advantage"].squeeze(-1)
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_attempts_and_idle_hands_are_not_learnt_from(make_ppo, collect, bank):
    _, env, one = make_ppo()
    two = make_ppo()[2]
    begin(env, one, collect)
    two.load_state_dict(one.state_dict())
    remember = one.process_step

    def spoil(state, action, reward, *rest):
        remember(state, action, reward, *rest)
        idle = ~bank.hand_active[state[keys.MOTION].squeeze(-1)] | state[keys.ATTEMPT]
        assert idle[ATTEMPTS:].any()
        action = action.masked_fill(idle.unsqueeze(-1), 7.0)
        two.process_step(state, action, reward.masked_fill(idle, 1e6), *rest)

    one.process_step = spoil
    collect(env, one, HORIZON)
    two.generator.set_state(one.generator.get_state())
    one.update()
    two.update()
    assert all_equal(one, two)


def test_a_blown_up_world_costs_its_last_step_only(make_ppo, collect):
    """Its state is NaN and the episode has ended; the steps before it still count."""
    _, env, learner = make_ppo()
    begin(env, learner, collect)
    remember, world = learner.process_step, WORLDS - 1

    def blow_up(state, action, reward, after, terminated, done):
        if len(learner._rollout) == 4:
            after, reward = after.clone(), reward.clone()
            after[keys.OBJECT_POSE][world] = float("nan")
            reward[world] = float("nan")
            terminated, done = terminated.clone(), done.clone()
            terminated[world] = done[world] = True
        remember(state, action, reward, after, terminated, done)

    learner.process_step = blow_up
    collect(env, learner, HORIZON)
    batches, _, shown = learner.batches()
    motion = shown[keys.GROUP_MASK].unflatten(0, (WORLDS - ATTEMPTS, HORIZON))
    for i, name in enumerate(learner.agents):
        expected = motion[..., i].clone()
        expected[-1, 4] = False
        assert torch.equal(batches[name]["mask"].squeeze(-1), expected)
    report = learner.update()
    assert learner.num_dropped == 1
    assert all(torch.isfinite(v).all() for v in report.values(True, True))
    assert all(torch.isfinite(p).all() for p in parameters(learner))


@pytest.mark.parametrize("groups", GROUPS)
def test_state_dict_continues_bit_for_bit(make_ppo, collect, tmp_path, groups):
    bench, env, one = make_ppo(groups)
    td = begin(env, one, collect)
    td = collect(env, one, HORIZON, td)
    one.update()
    save_checkpoint(tmp_path, {"env_steps": 7, "learner": one.state_dict()}, keep=1)
    two = bench.make_learner(env)
    assert not all_equal(one, two)
    two.load_state_dict(load_checkpoint(tmp_path)["learner"])
    assert torch.equal(one.act(td), two.act(td))
    remember = one.process_step
    one.process_step = lambda *args: (remember(*args), two.process_step(*args))
    collect(env, one, 3, td)
    assert one.num_rows == 3 * (WORLDS - ATTEMPTS)
    one.forget_episodes()
    two.forget_episodes()
    assert one.num_rows == 0
    collect(env, one, HORIZON)
    two.generator.set_state(one.generator.get_state())
    a, b = one.update(), two.update()
    assert all(torch.equal(a[k], b[k]) for k in a.keys(True, True))
    assert all_equal(one, two)
    assert two.updates == 2


def test_another_algorithm_s_checkpoint_is_refused(make_ppo, make_bench):
    learner = make_ppo()[2]
    other = make_bench(WORLDS)
    state = other.make_learner(other.make_env()).state_dict()
    with pytest.raises(RunError, match="not one of PPO with the groups left, right"):
        learner.load_state_dict(state)


@pytest.fixture
def ppo_run(make_ppo, library, tmp_path):
    """A run of three rollouts, two of them learnt from."""
    from flashdex.recipe import validate
    from flashdex.training.run_dir import train

    recipe = dataclasses.replace(
        make_ppo()[0].recipe,
        total_env_steps=WORLDS * HORIZON * 3,
        run_dir=str(tmp_path / "run"),
        motions=MotionsConfig(library=str(library.path)),
        train=TrainConfig(certify=False, render_conversions=False),
    )
    return train(validate(recipe))


def test_a_run_trains_and_is_evaluated(ppo_run, library):
    from flashdex.training.run_dir import evaluate

    assert load_checkpoint(ppo_run)["learner"]["updates"] == 2
    result = evaluate(ppo_run)
    assert [row["motion"] for row in result["motions"]] == library.names
    assert result["totals"]["env_steps"] == WORLDS * HORIZON * 3
    assert evaluate(ppo_run, ["env.num_envs=4"]) == result
    with pytest.raises(RunError, match="does not fit the recipe"):
        evaluate(ppo_run, ["algo.ppo.hidden=[32]"])


def test_a_resume_takes_another_learning_rate(ppo_run):
    from flashdex.training.run_dir import resume

    def rates():
        agents = load_checkpoint(ppo_run)["learner"]["agents"]
        return [a["optimizer"]["param_groups"][0]["lr"].item() for a in agents.values()]

    steered = rates()
    total = 2 * load_checkpoint(ppo_run)["env_steps"]
    words = ["algo.ppo.lr=2e-5", "algo.ppo.target_kl=null"]
    resume(ppo_run, [f"total_env_steps={total}", *words])
    assert min(steered) > 2e-5
    assert rates() == pytest.approx([2e-5] * len(steered))
