"""Training on stock environments, against ones that are stepped by hand."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gym_runs import STEPS, TINY, learner_of, read_metrics, tiny_recipe, trainer_of
from tensordict import TensorDict

from flashdex.cli.main import main
from flashdex.envs.config import GymConfig
from flashdex.envs.gym import GymEnv
from flashdex.recipe import GymRecipe, compose
from flashdex.training.run_dir import train
from flashdex.training.tasks.gym import evaluate_policy

# The published curves are those of the -v4 environments.
pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


def observed(observation):
    """The state that a learner reads of observations, (N, D)."""
    return TensorDict({"observation": observation}, [len(observation)])


@pytest.fixture
def make_recipe(tmp_path):
    def make(*args, **kwargs):
        return tiny_recipe(tmp_path / "run", *args, **kwargs)

    return make


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a run that has reached its budget; not to be changed."""
    return train(tiny_recipe(tmp_path_factory.mktemp("gym") / "run"))


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "InvertedPendulum-v4"])
def test_worlds_agree_with_environments_stepped_by_hand(env_id):
    limit, seed = 9, 3
    config = GymConfig(env_id=env_id, max_episode_steps=limit)
    worlds = GymEnv(config, num_envs=2, seed=seed)
    hand = [gymnasium.make(env_id, max_episode_steps=limit) for _ in range(2)]
    space = hand[0].action_space
    starts = [e.reset(seed=seed + i)[0] for i, e in enumerate(hand)]
    td = worlds.reset()
    np.testing.assert_allclose(td["observation"], starts, rtol=1e-6, atol=1e-7)
    generator = torch.Generator().manual_seed(0)
    ends = {"terminated": 0, "truncated": 0}
    for _ in range(25):
        action = 2 * torch.rand(2, worlds.action_dim, generator=generator) - 1
        worlds.put_action(td, action)
        step = worlds.step(td)["next"]
        scaled = space.low + (action.numpy() + 1) / 2 * (space.high - space.low)
        found = [e.step(a) for e, a in zip(hand, scaled, strict=True)]
        observation, reward, terminated, truncated, _ = zip(*found, strict=True)
        np.testing.assert_allclose(
            step["observation"], observation, rtol=1e-4, atol=1e-4
        )
        np.testing.assert_allclose(step["reward"][:, 0], reward, rtol=1e-4, atol=1e-4)
        assert step["terminated"][:, 0].tolist() == list(terminated)
        only = [c and not t for c, t in zip(truncated, terminated, strict=True)]
        assert step["truncated"][:, 0].tolist() == only
        ends["terminated"] += sum(terminated)
        ends["truncated"] += sum(only)
        td = step
        if step["done"].any():
            td = worlds.reset_worlds(step["done"].squeeze(-1))
            after = td["observation"]
            for i, env in enumerate(hand):
                is_new = terminated[i] or truncated[i]
                wanted = env.reset()[0] if is_new else observation[i]
                np.testing.assert_allclose(after[i], wanted, rtol=1e-4, atol=1e-4)
    assert ends["truncated" if env_id == "Pendulum-v1" else "terminated"] >= 2


def swing(observation, action):
    """Pendulum-v1 in closed form: next observation and reward of an action, N m."""
    cos, sin, speed = observation.unbind(-1)
    angle, torque = torch.atan2(sin, cos), action[:, 0]
    reward = -(angle**2 + 0.1 * speed**2 + 0.001 * torque**2)
    speed = (speed + (15.0 * sin + 3.0 * torque) * 0.05).clamp(-8, 8)
    angle = angle + speed * 0.05
    return torch.stack([angle.cos(), angle.sin(), speed], -1), reward


def test_replay_holds_true_observations_where_an_episode_is_cut(make_recipe, tmp_path):
    trainer = trainer_of(make_recipe(algo={"min_buffer": 90}), tmp_path)
    td = trainer.reset()
    for _ in range(3 * STEPS):
        td = trainer.vector_step(td)
    rows = trainer.learner.buffer[:]
    following, reward = swing(rows["observation"], 2 * rows["action"])
    torch.testing.assert_close(
        rows["next_observation"], following, rtol=0, atol=1e-4, check_dtype=False
    )
    torch.testing.assert_close(rows["reward"][:, 0], reward, rtol=1e-3, atol=1e-3)
    assert not rows["terminated"].any()  # truncation bootstraps
    gap = (rows["next_observation"][:-1] - rows["observation"][1:]).abs().amax(-1)
    is_cut = torch.arange(1, 3 * STEPS) % STEPS == 0
    assert (gap[is_cut] > 0.01).all()
    assert (gap[~is_cut] == 0).all()


def test_warmup_is_uniform(make_recipe):
    recipe = make_recipe(num_envs=1)
    learner = learner_of(recipe)
    state = observed(torch.zeros(4000, 3))
    drawn = learner.act(state).squeeze(-1).sort().values
    expected = torch.linspace(-1, 1, 4000)
    # Kolmogorov-Smirnov: 0.03 is passed with probability above 0.99
    assert (drawn - expected).abs().max() < 2 * 0.03
    assert drawn.abs().max() <= 1
    still = learner.act(state[:2], explore=False)
    torch.testing.assert_close(still, learner.act(state[:2], explore=False))


def test_evaluation_agrees_with_episodes_played_by_hand(make_recipe):
    recipe = make_recipe("InvertedPendulum-v4", max_episode_steps=None)
    learner = learner_of(recipe)
    before = learner.generator.get_state()
    found = evaluate_policy(learner, GymEnv(recipe.gym, num_envs=3, seed=5))
    assert torch.equal(before, learner.generator.get_state())
    env = gymnasium.make("InvertedPendulum-v4")
    for i in range(3):
        observation, _ = env.reset(seed=5 + i)
        total, length, done = 0.0, 0, False
        while not done:
            state = observed(torch.tensor(observation[None], dtype=torch.float32))
            action = 3 * learner.act(state, explore=False)[0].numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            total, length = total + float(reward), length + 1
            done = terminated or truncated
        assert found.returns[i].item() == pytest.approx(total)
        assert found.lengths[i].item() == length


def test_a_run_trains_logs_and_resumes(tmp_path, capsys):
    folder = tmp_path / "run"
    sizes = [f"algo.{key}={value}" for key, value in TINY.items()]
    words = ["gym.env_id=Pendulum-v1", "gym.max_episode_steps=20", f"run_dir={folder}"]
    words += ["gym.eval_every_env_steps=50", "gym.eval_episodes=2", *sizes]
    words += ["total_env_steps=120", "train.torch_threads=0", "logger.kind=[csv]"]
    assert main(["train", "gym_halfcheetah_small", *words]) == 0
    assert "120 env steps" in capsys.readouterr().out
    records = read_metrics(folder)
    evaluated = [r["env_steps"] for r in records if "eval/return" in r]
    assert evaluated == [50, 100, 120]
    last = records[-1]
    # 61 steps with at least 60 rows, a quarter of an update each
    assert (last["updates"], last["buffer/rows"]) == (15, 120)
    assert all(math.isfinite(v) for r in records for v in r.values())
    assert main(["train", "--resume", str(folder), "total_env_steps=160"]) == 0
    last = read_metrics(folder)[-1]
    assert (last["env_steps"], last["updates"], last["buffer/rows"]) == (160, 25, 160)
    assert last["eval/return"] < 0
    capsys.readouterr()
    assert main(["evaluate", str(folder), "gym.eval_episodes=4"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["env_steps"], len(found["returns"])) == (160, 4)
    # Worlds are seeded one by one: the first two are those of the training run.
    assert np.mean(found["returns"][:2]) == pytest.approx(last["eval/return"], abs=1e-2)


def test_two_runs_of_one_seed_are_equal(finished, make_recipe):
    again = train(make_recipe())
    first, second = (read_metrics(folder)[-1] for folder in (finished, again))
    same = [key for key in first if not key.startswith(("perf/", "hours"))]
    assert {k: first[k] for k in same} == {k: second[k] for k in same}


def test_other_verbs_refuse_a_run_without_motions(finished, capsys):
    for verb in ("report", "replay"):
        assert main([verb, str(finished)]) == 2
        assert "task: gym" in capsys.readouterr().err


def test_gym_page_names_exactly_the_logged_keys(finished):
    page = (Path(__file__).parents[2] / "docs/gym.md").read_text()
    table = page.split("## Metrics")[1].split("\n## ")[0]
    named = set(re.findall(r"^\| `([^`]+)`", table, re.MULTILINE))
    assert {key for record in read_metrics(finished) for key in record} == named


@pytest.mark.learn
def test_pendulum_is_learnt(tmp_path):
    """Swing-up within 100 steps: untrained about -600, solved about -120."""
    words = ["gym.env_id=Pendulum-v1", f"run_dir={tmp_path / 'run'}"]
    words += ["total_env_steps=8_000", "gym.schedule_env_steps=8_000"]
    words += ["gym.num_envs=16", "gym.max_episode_steps=100", "algo.min_buffer=320"]
    words += ["gym.eval_every_env_steps=320", "algo.updates_per_step=6"]
    words += ["algo.critic_width=32", "algo.gamma=0.97", "algo.head=centred"]
    words += ["algo.init_std=0.5", "algo.lr=1e-3", "algo.lr_final=9e-4"]
    recipe = compose("gym_halfcheetah_small", words)
    assert isinstance(recipe, GymRecipe)
    records = read_metrics(train(recipe))
    returns = [r["eval/return"] for r in records if "eval/return" in r]
    assert returns[-1] > 0.4 * returns[0], returns
