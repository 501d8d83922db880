"""Stored rollouts replay bit for bit in plain MuJoCo C, contacts included."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flashdex import keys
from flashdex.metrics.criteria import score
from flashdex.rollouts.build import RolloutBuilder
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.rollouts.resimulation import load_simulation, resimulate
from flashdex.rollouts.rollout import Rollout


def shaky(scale, seed=0):
    """A controller of random actions."""
    generator = torch.Generator().manual_seed(seed)

    def act(td, env):
        return scale * (2 * torch.rand(env.num_envs, 2, 18, generator=generator) - 1)

    return act


@pytest.fixture(scope="module")
def attempts(roll_tiny):
    return roll_tiny(shaky(0.7))


def test_one_full_length_attempt_a_motion(attempts, library):
    assert [rollout.motion for rollout in attempts] == library.names
    for rollout, length in zip(
        attempts, library.motions["length"].tolist(), strict=True
    ):
        assert rollout.completed
        assert rollout.num_frames == length - 1
        assert rollout.reference_length == length - 1


@pytest.mark.parametrize("motion", [0, 1, 2])
def test_replay_is_bit_equal(attempts, tmp_path, motion):
    path = attempts[motion].save(tmp_path / "rollout.npz")
    rollout = Rollout.load(path)
    touched = 0

    def watch(model, data):
        nonlocal touched
        touched += sum(
            1 for c in data.contact if {model.geom_bodyid[g] for g in c.geom} - {0}
        )

    run = resimulate(load_simulation(rollout), monitor=watch)
    assert touched > 200
    assert (run.qpos == rollout.qpos).all()
    deviation = certify(rollout, num_perturbations=0).deviation
    assert deviation["max_mm"] == 0
    assert deviation["max_deg"] == 0
    assert deviation["first_frame_beyond"] == -1
    assert deviation["stored_mismatch_mm"] == 0


def test_what_is_scored_is_what_the_engine_measures(attempts):
    for rollout in attempts:
        run = resimulate(load_simulation(rollout))
        ours = rollout.score()
        theirs = score(run.errors, grace=rollout.grace)
        for name, verdict in ours.items():
            assert verdict.state == theirs[name].state
            for key, value in verdict.values.items():
                assert value == pytest.approx(theirs[name].values[key], abs=1e-5)


def test_rows_are_scored_on_the_right_frames(attempts, library):
    rollout = attempts[2]
    start, length = (int(library.motions[k][2]) for k in ("start", "length"))
    rows = slice(start + 1, start + length)
    ref = library.frames["object_pos"][rows].numpy()
    np.testing.assert_allclose(rollout.ref_object_pos, ref, atol=1e-7)
    tips = library.frames["keypoints"][rows][:, :, list(keys.TIP_KEYPOINTS)].numpy()
    np.testing.assert_allclose(rollout.ref_fingertips, tips, atol=1e-7)


def test_training_attempts_replay_bit_equal_after_resets(make_env):
    # worlds that were reset many times, beside assisted and terminated neighbours
    from flashdex.envs.mdp.assist import AssistConfig

    env = make_env(
        6,
        attempt_share=0.5,
        physics={"num_threads": 2},
        finger_mode="residual",
        assist=AssistConfig(enabled=True),
    )
    recorder = EpisodeRecorder(env)
    builder = RolloutBuilder(
        env.bank,
        env.hands,
        env.physics.scenes,
        decimation=env.physics.decimation,
        criterion="sr_mt_obj",
        seed=0,
        made_by={},
    )
    env.forced_motion = torch.tensor([2, 1, 0, 2, 1, 0])
    td, act, found = env.reset(), shaky(0.3), []
    recorder.record_start()
    for step in range(110):
        if step % 20 == 0:
            env.forced_motion = (env.forced_motion + 1) % 3
        action = act(td, env)
        for i, side in enumerate(keys.SIDES):
            td.set(keys.action(side), action[:, i])
        td = env.step(td)
        done = td["next", keys.DONE]
        found += recorder.record_step(action, done, step)
        td = env.maybe_reset(td["next"].clone())
        recorder.record_start()
    rollouts = [builder.build(episode) for episode in found]
    assert len(rollouts) > 5
    assert "both" in {rollout.motion for rollout in rollouts}
    for episode, rollout in zip(found[-6:], rollouts[-6:], strict=True):
        run = resimulate(load_simulation(rollout))
        assert (run.qpos == rollout.qpos).all()
        assert rollout.completed == (not rollout.terminations)
        assert episode.frame == rollout.num_frames
