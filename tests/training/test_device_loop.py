"""The loop as it runs on a device: nothing waits for it, and nothing is lost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from no_sync import forbid_sync
from torchrl.envs.utils import step_mdp

from flashdex import keys
from flashdex.envs.mdp.assist import AssistConfig, AssistEpoch
from flashdex.envs.tracking import TrackingEnv
from flashdex.rollouts.ledger import Ledger
from flashdex.rollouts.recorder import LOOK_EVERY, EpisodeRecorder
from flashdex.rollouts.scorer import InlineScorer
from flashdex.training.guard import GradientGuard
from flashdex.training.logging import MetricLog
from flashdex.training.session import SessionStart
from flashdex.training.tasks.tracking import TrackingTask
from flashdex.training.trainer import Trainer


def unseen(env: TrackingEnv) -> TrackingEnv:
    """The environment, as if the host had to wait for what it looks at."""
    env.is_host_device = False
    return env


@pytest.fixture
def make_trainer(make_bench, tmp_path):
    def make(engine, **settings):
        bench = make_bench(4, attempt_share=0.5, finger_mode="residual", **settings)
        physics = dataclasses.replace(bench.recipe.physics, engine=engine)
        recipe = dataclasses.replace(bench.recipe, physics=physics)
        bench = dataclasses.replace(bench, recipe=recipe)
        env = unseen(bench.make_env())
        task = TrackingTask(bench)
        task.env, task.recorder = env, EpisodeRecorder(env)
        task.assist_epoch = AssistEpoch(env.terms.gates)
        task.ledger = Ledger(
            tmp_path, bench.bank.names, criterion="sr_mt_obj", seed=0, engine=engine
        )
        maker = bench.rollout_builder(env.physics.scenes)
        task.scorer = InlineScorer(task.ledger, maker)
        trainer = Trainer(
            task,
            tmp_path,
            bench.make_learner(env),
            MetricLog(tmp_path, recipe),
            start=SessionStart(env_steps=0, wall_s=0.0, lost=0, run="0" * 32),
        )
        trainer.guard = GradientGuard(waits=False)
        return trainer

    return make


def test_a_vector_step_with_its_updates_waits_for_nothing(make_trainer):
    algo = {"min_buffer": 20, "updates_per_step": 2.0}
    trainer = make_trainer("warp", algo=algo, assist=AssistConfig(enabled=True))
    td = trainer.reset()
    with trainer.guard:
        for _ in range(LOOK_EVERY):
            td = trainer.vector_step(td)
        before = trainer.learner.updates
        with forbid_sync():
            for _ in range(LOOK_EVERY - 1):
                td = trainer.vector_step(td)
    assert trainer.learner.updates == before + 2 * (LOOK_EVERY - 1)
    trainer.worker.close()
    assert trainer.stats.pop(1.0, 4)["episode/ends"] > 0


def random_steps(env, steps, *, seed=0):
    """Yield (action, done) of random steps; restarts what has ended."""
    generator = torch.Generator().manual_seed(seed)
    td = env.reset()
    yield None, None
    for _ in range(steps):
        action = 2 * torch.rand(env.num_envs, 2, 18, generator=generator) - 1
        env.put_action(td, action)
        td = env.step(td)
        yield action, td["next", keys.DONE]
        done = td["next", keys.DONE]
        td = env.reset_worlds(done.squeeze(-1)) if done.any() else step_mdp(td)


def test_looking_seldom_finds_the_same_episodes(make_env):
    env = make_env(6, attempt_share=0.5)
    often, seldom = (EpisodeRecorder(env, look_every=n) for n in (1, 7))
    one, other = [], []
    for number, (action, done) in enumerate(random_steps(env, 200)):
        if action is None:
            continue
        # the state before the step is the one after the restart: the start comes first
        one += often.record_step(action, done, number)
        other += seldom.record_step(action, done, number)
        for recorder in (often, seldom):
            recorder.record_start()
    other += seldom.finished()
    assert len(one) == len(other) > 6
    for a, b in zip(one, other, strict=True):
        assert (a.env, a.env_steps, a.motion, a.frame) == (
            b.env,
            b.env_steps,
            b.motion,
            b.frame,
        )
        assert a.causes == b.causes
        for name in a.steps:
            np.testing.assert_array_equal(a.steps[name], b.steps[name])


def test_restart_is_the_reset_of_the_marked_worlds(make_env):
    one, two = make_env(5, seed=3), make_env(5, seed=3)
    roots = [one.reset(), two.reset()]
    for _ in range(4):
        action = one.rand_action(roots[0].clone())
        for i, env in enumerate((one, two)):
            roots[i] = step_mdp(env.step(action.clone()))
    mask = torch.tensor([True, False, True, False, False])
    asked = roots[0].set("_reset", mask.unsqueeze(-1))
    by_torchrl, ours = one.reset(asked), two.reset_worlds(mask)
    for key in (*keys.STATE, keys.ATTEMPT, keys.DONE):
        assert torch.equal(by_torchrl[key], ours[key]), key
    assert (by_torchrl[keys.FRAME][mask] != roots[1][keys.FRAME][mask]).any()
