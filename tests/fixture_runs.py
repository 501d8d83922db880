"""Builders and learners of tiny sizes on the synthetic library."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch
from synthetic import FRIENDLY

from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import EnvConfig
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.recipe import Recipe, TrainConfig

TINY = {
    "batch_size": 32,
    "buffer_size": 400,
    "min_buffer": 40,
    "n_step": 3,
    "actor_width": 16,
    "critic_width": 16,
    "num_atoms": 11,
    "future_latent": 8,
    "future_channels": [8, 8, 8],
}
CERTIFIED = {"certify": True, "render_conversions": False}


@pytest.fixture
def make_bench(library, hands, bank):
    """Make a RunBuilder: worlds, then fields of EnvConfig; ``algo`` of AlgoConfig."""
    from flashdex.training.build import RunBuilder

    def make(num_envs=6, *, algo=None, train=None, **env):
        small = {"object_points": {"num_points": 8}}
        transforms = {**EnvConfig().transforms, **small}
        recipe = dataclasses.replace(
            Recipe(name="tiny", total_env_steps=6000),
            env=EnvConfig(num_envs=num_envs, **{"transforms": transforms, **env}),
            algo=AlgoConfig(**{**TINY, **(algo or {})}),
            physics=PhysicsConfig(num_threads=1, **FRIENDLY),
            train=TrainConfig(**(train or {})),
        )
        return RunBuilder(recipe, library, hands, bank)

    return make


@pytest.fixture(scope="module")
def roll_tiny(library, hands, bank):
    """Roll every motion of the synthetic library under a controller."""
    from flashdex.training.build import RunBuilder
    from flashdex.training.evaluator import roll_all

    recipe = Recipe(
        name="tiny",
        total_env_steps=1,
        env=EnvConfig(num_envs=3, finger_mode="residual"),
        physics=PhysicsConfig(num_threads=1, **FRIENDLY),
    )
    bench = RunBuilder(recipe, library, hands, bank)

    def roll(controller):
        return list(roll_all(bench, controller))

    return roll


@pytest.fixture
def collect():
    """Act, step and remember for a number of vector steps; return the last root."""
    from flashdex import keys

    def run(env, learner, steps, td=None):
        td = env.reset() if td is None else td
        for _ in range(steps):
            action = learner.act(td)
            for i, side in enumerate(keys.SIDES):
                td.set(keys.action(side), action[:, i])
            td, root = env.step_and_maybe_reset(td)
            after = td["next"]
            reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
            learner.process_step(
                td, action, reward, after, after[keys.TERMINATED], after[keys.DONE]
            )
            td = root
        return td

    return run


@pytest.fixture(scope="session")
def start_tiny(library):
    """Train for 60 vector steps of 6 worlds in a folder; return it.

    Takes ``train`` and ``logger`` settings, motions to select, and fields of Recipe.
    """
    from flashdex.recipe import LoggerConfig, MotionsConfig, validate
    from flashdex.training.run_dir import train as start

    def run(folder, *, train=None, logger=None, select=None, **fields):
        transforms = {**EnvConfig().transforms, "object_points": {"num_points": 4}}
        settings = {"log_every_s": 0.2, "certify": False, "torch_threads": 1}
        settings |= {"stop_when_all_converted": False}
        recipe = dataclasses.replace(
            Recipe(name="tiny", total_env_steps=360),
            run_dir=str(folder),
            motions=MotionsConfig(library=str(library.path), select=select),
            physics=PhysicsConfig(num_threads=1, **FRIENDLY),
            env=EnvConfig(
                num_envs=6,
                attempt_share=0.5,
                finger_mode="residual",
                transforms=transforms,
            ),
            algo=AlgoConfig(**{**TINY, "n_step": 2, "updates_per_step": 1.0}),
            train=TrainConfig(**{**settings, **(train or {})}),
            logger=LoggerConfig(**(logger or {})),
            **fields,
        )
        return start(validate(recipe))

    return run


@pytest.fixture(scope="session")
def converted_run(start_tiny, tmp_path_factory):
    """A finished run of one motion, with a certificate."""
    folder = tmp_path_factory.mktemp("converted") / "run"
    return start_tiny(folder, train=CERTIFIED, select=["right_box"])


@pytest.fixture(scope="session")
def converted_pair(start_tiny, tmp_path_factory):
    """A finished run of several motions, with certificates."""
    return start_tiny(tmp_path_factory.mktemp("pair") / "run", train=CERTIFIED)


@pytest.fixture(scope="session")
def truth(converted_run):
    """Recipe and library of the converted run."""
    from flashdex.training.loaded import open_truth

    found, why = open_truth(converted_run)
    assert found is not None, why
    return found


@pytest.fixture
def spoilt_run(converted_run, tmp_path):
    """A copy of the converted run, for a test to tamper with."""
    return Path(shutil.copytree(converted_run, tmp_path / "run"))


@pytest.fixture(scope="session")
def tiny_runs():
    """Finished runs by their settings, to be copied."""
    return {}


@pytest.fixture
def train_tiny(start_tiny, tiny_runs, tmp_path, tmp_path_factory):
    """A run of ``start_tiny`` that the test may spoil: a copy of one trained before."""

    def run(**settings):
        key = repr(settings)
        if key not in tiny_runs:
            folder = tmp_path_factory.mktemp("tiny") / "run"
            tiny_runs[key] = start_tiny(folder, **settings)
        return Path(shutil.copytree(tiny_runs[key], tmp_path / "run"))

    return run
