"""What `import flashdex` gives, used as a TorchRL user would."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
import torch
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

import flashdex
from flashdex.errors import FlashdexError, RecipeError, RunError


@pytest.fixture(scope="module")
def run_dir(start_tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("front") / "run"
    return start_tiny(folder, train={"criterion": "sr_spider_raw"})


@pytest.fixture(scope="module")
def recipe(run_dir):
    return flashdex.load_run(run_dir).recipe


def test_importing_is_cheap_and_names_are_public():
    code = "import sys, flashdex; print('torch' in sys.modules, *flashdex.__all__)"
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.split() == [
        "False",
        *("compose", "load_library", "load_policy", "load_run", "make_env"),
    ]


def test_an_env_fits_torchrl_and_its_seed(recipe):
    env = flashdex.make_env(recipe, num_envs=3, seed=1)
    check_env_specs(env)
    assert env.base_env.group_map == {"left": ["left"], "right": ["right"]}
    first, second = (
        flashdex.make_env(recipe, num_envs=3, seed=1).rollout(4, _still(env))
        for _ in range(2)
    )
    assert torch.equal(first["observation"], second["observation"])
    other = flashdex.make_env(recipe, num_envs=3, seed=2).rollout(4, _still(env))
    assert not torch.equal(first["observation"], other["observation"])


def _still(env):
    zeros = env.full_action_spec.zero()
    return lambda td: td.update(zeros)


def test_a_library_is_a_folder_or_that_of_a_recipe(recipe, library):
    opened = flashdex.load_library(library.path)
    assert opened.names == flashdex.load_library(recipe).names == library.names
    one = flashdex.compose(
        "quickstart", [f"motions.library={library.path}", "motions.count=1"]
    )
    assert flashdex.load_library(one).names == library.names[:1]


def test_a_run_tells_what_it_stored(run_dir):
    run = flashdex.load_run(run_dir)
    assert run.metrics[-1]["env_steps"] == run.recipe.total_env_steps
    assert len(run.attempts) == run.metrics[-1]["convert/attempts"]
    for motion in run.converted:
        assert run.rollout(motion).motion == motion
    with pytest.raises(RunError, match=r"no rollout of 'nothing'\. Stored: "):
        run.rollout("nothing")


def test_a_policy_acts_as_the_evaluation_does(run_dir, recipe):
    from flashdex.training.run_dir import load_learner

    env = flashdex.make_env(recipe, num_envs=3, seed=0, evaluation=True)
    policy = flashdex.load_policy(run_dir)
    td = policy(env.reset())
    _, learner, _ = load_learner(run_dir)
    wanted = learner.act(td, explore=False)
    for i, key in enumerate(policy.out_keys):
        assert torch.equal(td[key], wanted[:, i])
    moved = env.rollout(3, policy)
    assert moved.shape == (3, 3)
    free = flashdex.make_env(recipe, num_envs=3, seed=0)
    free.base_env.attempt[:] = False
    start = free.reset()
    with set_exploration_type(ExplorationType.RANDOM):
        noisy = policy(start.clone())
    assert not torch.equal(noisy["right", "action"], policy(start)["right", "action"])


def test_mistakes_are_told(tmp_path):
    with pytest.raises(RecipeError, match="num_env"):
        flashdex.compose("quickstart", ["env.num_env=3"])
    with pytest.raises(RunError, match="not a run directory"):
        flashdex.load_run(tmp_path)
    with pytest.raises(FlashdexError, match="task: retarget"):
        flashdex.make_env("gym_halfcheetah_small")
    with pytest.raises(FlashdexError):
        flashdex.load_library(tmp_path)
    (tmp_path / "torn.yaml").write_text("seed: [")
    with pytest.raises(RecipeError) as found:
        flashdex.compose(tmp_path / "torn.yaml")
    assert len(found.value.problems) == 1  # nothing is said to be missing


@pytest.mark.parametrize(
    ("call", "words", "expected"),
    [
        ("compose", [None], "name: expected str or Path, found None"),
        ("compose", ["quickstart", "seed=3"], "overrides: expected list or tuple"),
        ("compose", ["quickstart", [3]], r"overrides\[0\]: expected str, found 3"),
        ("make_env", [{"name": "quickstart"}], "expected RunRecipe or str or Path"),
        ("load_library", [None], "expected RunRecipe or str or Path"),
        ("load_run", [b"runs/a"], "expected str or Path, found b'runs/a'"),
        ("load_policy", [{}], "expected str or Path"),
    ],
)
def test_what_is_of_another_type_is_told(call, words, expected):
    with pytest.raises(FlashdexError, match=expected):
        getattr(flashdex, call)(*words)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ({"num_envs": 0}, "num_envs: 0 must be at least 1"),
        ({"num_envs": "4"}, "num_envs: expected an integer"),
        ({"num_envs": 10**9}, "num_envs: 1000000000 must be at most"),
        ({"seed": -1}, "seed: -1 must be at least 0"),
        ({"seed": 1.5}, "seed: expected an integer"),
        ({"evaluation": "no"}, "evaluation: expected bool"),
    ],
)
def test_numbers_of_an_env_are_held_to_the_schema(recipe, words, expected):
    with pytest.raises(FlashdexError, match=expected):
        flashdex.make_env(recipe, **words)


def test_a_recipe_changed_in_python_is_checked(recipe):
    changed = dataclasses.replace(recipe.env, num_envs="4")
    with pytest.raises(RecipeError, match=r"env\.num_envs: expected an integer"):
        flashdex.make_env(dataclasses.replace(recipe, env=changed))
