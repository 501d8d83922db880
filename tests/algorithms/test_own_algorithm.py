"""An algorithm of one's own: one file with its config, registered, and trained."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict

from flashdex import keys
from flashdex.algorithms.base import ALGORITHMS, Learner, register, snapshot
from flashdex.algorithms.config import AlgoConfig
from flashdex.errors import RecipeError, RunError
from flashdex.recipe import compose
from flashdex.recipe.merge import load_recipe
from flashdex.system.fields import number
from flashdex.system.jsonl import read_lines
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.run_dir import evaluate, resume, train


@dataclass(frozen=True, kw_only=True)
class HillConfig(AlgoConfig):
    """Random search on one constant action."""

    kind: str = "hill"
    spread: float = number(0.1, above=0, high=10)
    """Standard deviation of a change."""
    patience: int = number(2, low=1, high=10_000)
    """Vector steps for which a change is tried."""


class Hill(Learner):
    """Adds noise to a constant action, and keeps it when the reward rises."""

    config_class = HillConfig
    immutable_keys = (*Learner.immutable_keys, "algo.patience")
    updates = num_rows = 0

    def __init__(self, config, spec):
        self.config, self.device = config, spec.device
        self.generator = torch.Generator(spec.device).manual_seed(spec.seed)
        self.mean = torch.zeros(2, spec.action_dim, device=spec.device)
        self.change, self.best = torch.zeros_like(self.mean), -1e9
        self.found, self.transforms = [], spec.transforms

    def act(self, state, *, explore=True):
        change = self.change * ~state[keys.ATTEMPT].unsqueeze(-1)
        return (self.mean + change * explore).clamp(-1, 1)

    def process_step(self, state, action, reward, next_state, terminated, done):
        self.found.append(reward.mean().item())
        self.num_rows = len(self.found)

    def num_updates(self):
        return int(len(self.found) >= self.config.patience)

    def update(self):
        reward = sum(self.found) / len(self.found)
        if reward > self.best:
            self.mean, self.best = self.mean + self.change, reward
        noise = torch.randn(self.mean.shape, generator=self.generator)
        self.change, self.found = self.config.spread * noise, []
        self.updates += 1
        return TensorDict({"reward": torch.tensor(reward)})

    def forget_episodes(self):
        self.found = []

    def state_dict(self):
        names = ("mean", "change", "best", "updates")
        state = {name: getattr(self, name) for name in names}
        return snapshot({**state, "generator": self.generator.get_state()})

    def load_state_dict(self, state):
        state = snapshot(state)
        self.generator.set_state(state.pop("generator"))
        vars(self).update(state)

    @classmethod
    def gentler(cls, config):
        return f"algo.spread={config.spread / 2:g}"

    @classmethod
    def conflicts(cls, config, budget, worlds):
        (num_envs,) = worlds.values()
        if config.patience * num_envs > budget:
            return [f"algo.patience: {config.patience} steps exceed the budget"]
        return []


@pytest.fixture(autouse=True)
def hill():
    register("hill")(Hill)
    yield
    del ALGORITHMS["hill"]


@pytest.fixture
def recipe_file(library, tmp_path):
    """A recipe in a file: four worlds on the tiny library, 20 vector steps."""
    path = tmp_path / "mine.yaml"
    path.write_text(
        f"""
total_env_steps: 80
run_dir: {tmp_path / "run"}
motions: {{library: {library.path}, control_hz: {library.fps}}}
physics: {{num_threads: 1, timestep: {1 / library.fps / 4}, decimation: 4,
  object_friction: 2.0}}
env: {{num_envs: 4, attempt_share: 0.5, finger_mode: residual}}
algo: {{kind: hill, spread: 0.2, buffer_size: 1000, batch_size: 32, critic_width: 16}}
train: {{certify: false, render_conversions: false}}
"""
    )
    return path


def test_it_trains_resumes_and_is_evaluated_from_a_recipe(recipe_file, library):
    recipe = compose(recipe_file)
    assert isinstance(recipe.algo, HillConfig)
    assert (recipe.algo.kind, recipe.algo.spread) == ("hill", 0.2)
    run_dir = train(recipe)
    (record,) = read_lines(run_dir / "metrics.jsonl")[-1:]
    assert (record["env_steps"], record["updates"]) == (80, 10)
    assert record["loss/reward"] != 0
    learned = load_checkpoint(run_dir)["learner"]
    assert (learned["mean"] != 0).any()
    resume(run_dir, ["total_env_steps=120", "algo.spread=0.1"])
    assert load_checkpoint(run_dir)["learner"]["updates"] == 15
    assert load_recipe(run_dir / "recipe.yaml").algo.spread == 0.1
    with pytest.raises(RunError, match=r"algo\.patience from 2 to 3"):
        resume(run_dir, ["algo.patience=3"])
    rows = evaluate(run_dir)["motions"]
    assert [row["motion"] for row in rows] == library.names


def test_its_keys_are_checked_like_all_others(recipe_file):
    words = ["algo.spread=-1", "algo.patience=1000", "algo.spred=1"]
    with pytest.raises(RecipeError) as caught:
        compose(recipe_file, words)
    found = "\n".join(caught.value.problems)
    for expected in (
        "algo.spread: -1 must be greater than 0",
        "algo.patience: 1000 steps exceed the budget",
        "algo.spred: unknown key. Did you mean 'spread'?",
    ):
        assert expected in found


def test_it_is_refused_where_it_cannot_train(recipe_file):
    for name, word, expected in (
        ("gym_halfcheetah", "algo.kind=hill", "not available with task: gym"),
        ("quickstart", "algo.kind=hil", r"Did you mean 'hill'\? Allowed: "),
        ("quickstart", "algo.spread=1", "unknown key"),
    ):
        with pytest.raises(RecipeError, match=expected):
            compose(name, [word])


def test_what_is_not_finite_names_the_gentler_override(recipe_file, monkeypatch):
    monkeypatch.setattr(
        Hill, "update", lambda self: TensorDict({"reward": torch.tensor(float("nan"))})
    )
    recipe = compose(recipe_file)
    logs = dataclasses.replace(recipe.train, log_every_s=1e-6)
    with pytest.raises(RunError, match=r"algo\.spread=0\.1\. "):
        train(dataclasses.replace(recipe, train=logs))
