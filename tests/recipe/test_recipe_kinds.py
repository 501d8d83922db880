"""Recipes of two kinds: each refuses the keys of the other, all at once."""

from __future__ import annotations

import re

import pytest

from flashdex.errors import FlashdexError, RecipeError
from flashdex.recipe import (
    GymRecipe,
    Recipe,
    compose,
    dump_recipe,
    expect_kind,
    load_recipe,
    task_of_run,
)


def problems_of(name, *overrides):
    with pytest.raises(RecipeError) as caught:
        compose(name, overrides)
    return caught.value.problems


def test_published_settings_of_one_cpu_environment():
    """Table of the FlashSAC paper: one environment, 1M steps."""
    recipe = compose("gym_halfcheetah")
    algo, gym = recipe.algo, recipe.gym
    assert (gym.env_id, gym.num_envs, gym.eval_episodes) == ("HalfCheetah-v4", 1, 50)
    assert (recipe.total_env_steps, gym.eval_every_env_steps) == (1_000_000, 100_000)
    assert (algo.batch_size, algo.updates_per_step) == (512, 1)
    assert (algo.buffer_size, algo.min_buffer) == (1_000_000, 10_000)
    assert (algo.gamma, algo.n_step, algo.tau) == (0.99, 1, 0.01)
    assert (algo.actor_width, algo.critic_width) == (128, 256)
    assert (algo.actor_blocks, algo.critic_blocks) == (2, 2)
    assert (algo.num_atoms, algo.v_max) == (101, 5)
    assert (algo.lr, algo.lr_final, algo.actor_lr_scale) == (3e-4, 1.5e-4, 1)
    assert (algo.actor_period, algo.actor_delay, algo.head) == (2, 0, "unit")
    assert (algo.alpha_init, algo.target_std, algo.warmup) == (0.01, 0.15, "uniform")
    assert (algo.noise_max_repeat, algo.noise_exponent) == (16, 2)
    assert (algo.noise_clock, algo.norm_warmup) == ("shared", False)


def test_the_small_recipe_is_the_beginning_of_a_published_run():
    small, whole = compose("gym_halfcheetah_small"), compose("gym_halfcheetah")
    assert small.schedule_env_steps == whole.schedule_env_steps == 1_000_000
    changed = {
        key
        for key, value in vars(whole.algo).items()
        if getattr(small.algo, key) != value
    }
    assert changed == {"batch_size", "actor_width", "critic_width"}


def test_mistakes_are_reported_at_once():
    found = problems_of(
        "gym_halfcheetah",
        "ablation=no_future",
        "physics.engine=cpu",
        "gym.num_env=3",
        "gym.env_id=os:system",
        "algo.groups=unified",
        "train.certify=false",
        "gym.schedule_env_steps=5",
    )
    for pattern in (
        r"^env: belongs to recipes with task: retarget, this one has task: gym",
        r"^physics: belongs to recipes with task: retarget",
        r"^gym\.num_env: unknown key\. Did you mean 'num_envs'\?",
        r"^gym\.env_id: 'os:system' names a module",
        r"^algo\.groups: has no effect with task: gym",
        r"^train\.certify: unknown key",
        r"^gym\.schedule_env_steps: 5 ends before",
    ):
        assert [p for p in found if re.search(pattern, p)], (pattern, found)
    assert len(found) == 7


@pytest.mark.parametrize(
    ("name", "override", "expected"),
    [
        ("quickstart", "gym.num_envs=2", "gym: belongs to recipes with task: gym"),
        ("gym_halfcheetah", "hand=xhand", "hand: belongs to recipes with task: retar"),
        ("gym_halfcheetah", "physics=cpu", "physics: belongs to recipes with task"),
        ("quickstart", "task=gim", "task: 'gim' is not a task. Did you mean 'gym'?"),
        ("gym_halfcheetah", "gym.env_id=''", "gym.env_id: missing"),
        ("gym_halfcheetah", "algo.kind=ppo", "algo.kind: 'ppo' is not available"),
        ("gym_halfcheetah", "algo.lr=1e-5", "algo.lr_final: 0.00015 is above"),
        ("gym_halfcheetah", "algo.buffer_size=1", "must exceed gym.num_envs x"),
        ("gym_halfcheetah", "expect=[{metric: a, at_env_steps: 5}]", "expect[0]"),
    ],
)
def test_a_wrong_override_names_its_place(name, override, expected):
    assert expected in "\n".join(problems_of(name, override))


def test_a_dumped_gym_recipe_reads_back_equal(tmp_path):
    recipe = compose("gym_halfcheetah", ["seed=3", "gym.env_id=Hopper-v4"])
    dump_recipe(recipe, tmp_path / "recipe.yaml")
    assert load_recipe(tmp_path / "recipe.yaml") == recipe
    assert task_of_run(tmp_path) == "gym"
    assert task_of_run(tmp_path / "nowhere") == "retarget"


def test_a_recipe_of_the_wrong_kind_is_refused():
    recipe = compose("gym_halfcheetah")
    assert expect_kind(recipe, GymRecipe, where="here") is recipe
    with pytest.raises(FlashdexError, match="here: needs a recipe with task: retarget"):
        expect_kind(recipe, Recipe, where="here")
