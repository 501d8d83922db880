"""Tiny runs on stock environments."""

from __future__ import annotations

from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import GymConfig
from flashdex.recipe import GymRecipe, LoopConfig
from flashdex.system.jsonl import read_lines, write_object
from flashdex.training.run_dir import make_trainer
from flashdex.training.tasks.gym import GymTask

TINY = {
    "batch_size": 16,
    "buffer_size": 1000,
    "min_buffer": 60,
    "n_step": 1,
    "actor_width": 16,
    "critic_width": 16,
    "num_atoms": 11,
    "head": "unit",
    "updates_per_step": 0.25,
}
STEPS = 20  # of an episode, below


def tiny_recipe(folder, env_id="Pendulum-v1", *, algo=None, train=None, **gym):
    config = {
        "max_episode_steps": STEPS,
        "eval_every_env_steps": 50,
        "eval_episodes": 3,
        **gym,
    }
    return GymRecipe(
        name="tiny",
        total_env_steps=120,
        run_dir=str(folder),
        gym=GymConfig(env_id=env_id, **config),
        algo=AlgoConfig(**{**TINY, **(algo or {})}),
        # no record by time: on a slow machine it would be one more
        train=LoopConfig(**{"log_every_s": 1e6, **(train or {})}),
    )


def trainer_of(recipe, tmp_path):
    folder = tmp_path / "loose"
    folder.mkdir(parents=True)
    write_object({"run": "0" * 32}, folder, "versions.json")
    return make_trainer(GymTask(recipe), folder)


def learner_of(recipe):
    task = GymTask(recipe)
    return task.make_learner(task.make_env())


def read_metrics(folder):
    return read_lines(folder / "metrics.jsonl")
