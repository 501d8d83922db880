"""The environment as TorchRL sees it: specs, resets, ends, seeds."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from flashdex import keys
from flashdex.envs.mdp.assist import AssistConfig

FLAGS = (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
NO_ENDS = {"terminations": {"sanity": {}}}


def state_of(td):
    return td.select(*keys.STATE, keys.ATTEMPT)


def same(a, b):
    return all(torch.equal(a[k], b[k]) for k in (*keys.STATE, keys.ATTEMPT))


def act(env, td, value=0.0):
    """Step with one constant action; return the step's output."""
    for side in keys.SIDES:
        td.set(keys.action(side), torch.full((env.num_envs, 18), value))
    return env.step(td)


def object_sum(env):
    """The running sum that one termination keeps."""
    _, early_reset = env.terms.terminations["early_reset"]
    return early_reset.object_sum


@pytest.mark.parametrize("evaluation", [False, True])
def test_specs(make_env, evaluation):
    check_env_specs(make_env(3, evaluation=evaluation), seed=0)


def test_next_state_is_the_coming_root_unless_an_episode_ended(make_env):
    env = make_env(8)
    td = env.rollout(70, break_when_any_done=False)
    done = td["next", keys.DONE][:, :-1, 0]
    assert done.any()
    for key in (*keys.STATE, keys.ATTEMPT):
        assert torch.equal(td[key][:, 1:][~done], td["next", key][:, :-1][~done])
    fresh = td[keys.FRAME][:, 1:][done]
    assert (fresh != td["next", keys.FRAME][:, :-1][done]).any()


def test_frames_and_flags(make_env, bank):
    env = make_env(6, attempt_share=0.5, **NO_ENDS)
    td = env.rollout(80, break_when_any_done=False)
    after = td["next"]
    ended, motion = after[keys.TRUNCATED][..., 0], td[keys.MOTION][..., 0]
    assert ended.any()
    assert not after[keys.TERMINATED].any()
    assert torch.equal(after[keys.DONE], after[keys.TRUNCATED])
    # the step that is scored on the last frame is the last one
    last = td[keys.FRAME][..., 0] >= bank.length[motion] - 1
    assert torch.equal(ended, last)
    assert torch.equal(after[keys.FRAME], td[keys.FRAME] + 1)
    starts = td[keys.FRAME][:, 1:][ended[:, :-1]][:, 0]
    assert (starts >= 1).all()


def test_time_limit_truncates(make_env):
    env = make_env(2, attempt_share=1.0, max_seconds=0.1, **NO_ENDS)
    td = env.rollout(12, break_when_any_done=False)
    steps = td["next", keys.TRUNCATED][0, :, 0].nonzero().squeeze(-1)
    assert steps.tolist() == [5, 11]


def test_final_observation_is_the_one_before_the_reset(make_env, bank):
    motion = torch.tensor([1, 0])
    envs = [make_env(2, seed=3, evaluation=True) for _ in range(2)]
    tds = []
    for env in envs:
        env.forced_motion = motion
        tds.append(env.reset())
    for _ in range(int(bank.length[1]) - 1):
        assert same(*tds)
        one = act(envs[0], tds[0])
        two, tds[0] = envs[1].step_and_maybe_reset(act_only(envs[1], tds[1]))
        tds[0], tds[1] = step_mdp(one), tds[0]
    assert two["next", keys.TRUNCATED][:, 0].tolist() == [True, False]
    # the twin that was not reset agrees on `next`, and the root has moved on
    assert same(one["next"], two["next"])
    assert tds[1][keys.FRAME][0] == 1
    assert tds[0][keys.FRAME][0] == bank.length[1]
    assert not torch.equal(tds[0][keys.JOINT_POS][0], tds[1][keys.JOINT_POS][0])
    assert torch.equal(tds[0][keys.JOINT_POS][1], tds[1][keys.JOINT_POS][1])


def act_only(env, td):
    for side in keys.SIDES:
        td.set(keys.action(side), torch.zeros(env.num_envs, 18))
    return td


def test_partial_reset_touches_only_its_worlds(make_env):
    env = make_env(4)
    td = env.reset()
    for _ in range(4):
        td = step_mdp(act(env, td, 0.2))
    mask = torch.tensor([[False], [True], [False], [True]])
    before = state_of(td).clone()
    internals = (env.steps.clone(), env._filter.clone(), object_sum(env).clone())
    after = env.reset(td.clone().set("_reset", mask))
    kept = ~mask[:, 0]
    assert same(state_of(after)[kept], before[kept])
    assert (env.steps[mask[:, 0]] == 0).all()
    for now, old in zip(
        (env.steps, env._filter, object_sum(env)), internals, strict=True
    ):
        assert torch.equal(now[kept], old[kept])
        assert not now[mask[:, 0]].any()
    assert not any(after[flag].any() for flag in FLAGS)


def test_attempt_worlds_start_at_frame_zero_without_noise(make_env, bank):
    env = make_env(16, attempt_share=0.5, seed=5)
    assert env.num_attempts == 8
    for _ in range(3):
        td = env.reset()
        attempt = td[keys.ATTEMPT][:, 0]
        motion = td[keys.MOTION][:, 0]
        assert (td[keys.FRAME][attempt] == 1).all()
        ref = bank.at(motion, td[keys.FRAME][:, 0] - 1)
        active = bank.hand_active[motion]
        exact = (td[keys.JOINT_POS] == ref["joint_pos"]).all(-1) | ~active
        assert exact[attempt].all()
        assert not exact[~attempt].all()
        still = (td[keys.JOINT_VEL] == ref["joint_vel"]).all(-1) | ~active
        assert still[attempt].all()
    assert (td[keys.FRAME][~attempt] > 1).any()


def test_reset_noise_has_the_stated_sizes(make_env, bank, hands):
    env = make_env(400, attempt_share=0.0)
    env.forced_motion = torch.full((400,), 2)
    td = env.reset()
    ref = bank.at(td[keys.MOTION][:, 0], td[keys.FRAME][:, 0] - 1)
    off = td[keys.JOINT_POS] - ref["joint_pos"]
    assert off[..., :3].std().item() == pytest.approx(0.001, rel=0.1)
    assert off[..., 3:6].std().item() == pytest.approx(math.radians(1.0), rel=0.1)
    span = torch.as_tensor(hands["left"].joint_range[9]).diff().item()
    assert off[:, 0, 9].std().item() == pytest.approx(0.0125 * span, rel=0.15)
    vel = td[keys.JOINT_VEL]
    assert (vel - ref["joint_vel"])[..., :6].std().item() == pytest.approx(
        0.001, rel=0.1
    )
    assert vel[..., 6:].std().item() == pytest.approx(0.01, rel=0.1)
    frames = td[keys.FRAME][:, 0] - 1
    assert frames.min() >= 0
    assert frames.max() <= 0.99 * 52


def test_attempt_worlds_get_no_assist(make_env):
    assist = AssistConfig(enabled=True)
    env = make_env(8, attempt_share=0.5, assist=assist)
    assert (env.assist_kp[:4] == 0).all()
    assert (env.assist_kp[4:] == 80).all()
    assert (env.assist_kv[4:] == 5).all()
    assert make_env(2, evaluation=True, assist=assist).assist is None
    # equal states: the assist moves the lifted object of a training world only
    env.forced_motion = torch.full((8,), 2)
    td = env.reset()
    env.frame[:] = 50
    td = act(env, td)
    forces = env.physics.batch.bind("xfrc_applied")
    body = env.physics.scene(0).model.body("object0").id
    assert not forces[:4].any()
    assert (forces[4:, body, 2] != 0).any()


def test_evaluation_ends_for_sanity_only(make_env):
    env = make_env(3, evaluation=True)
    env.forced_motion = torch.arange(3)
    assert set(env.terms.terminations) == {"sanity"}
    td = env.reset()
    for _ in range(29):
        td = act(env, td, -1.0)
        assert not td["next", keys.TERMINATED].any()
        td = step_mdp(td)
    env.physics._qvel[2] = 1e12
    td = act(env, td)
    assert td["next", keys.TERMINATED][:, 0].tolist() == [False, False, True]
    blame = env.last_step.failed
    assert blame[2].tolist() == [True, True]


def test_failure_terminates_with_blame(make_env, bank):
    env = make_env(3, seed=1, attempt_share=0.0)
    env.forced_motion = torch.full((3,), 2)
    env.reset()
    raw = env.physics._qpos
    address = env.physics.scene(0).object_qpos(1)  # the ball, held by the left hand
    raw[1, address + 2] -= 0.2
    raw[1, address] += 0.4
    td = act(
        env, env.reset(TensorDict({"_reset": torch.zeros(3, 1, dtype=torch.bool)}, [3]))
    )
    after = td["next"]
    assert after[keys.TERMINATED][:, 0].tolist() == [False, True, False]
    assert not after[keys.TRUNCATED].any()
    assert env.last_step.terminations["object_dropped"][1].tolist() == [True, False]
    assert after[keys.reward("left")][1, 0] < -1.6
    assert after[keys.reward("right")][1, 0] > -0.1
    assert after[keys.reward("left")][0, 0] > -0.1


def test_rewards_are_those_of_the_named_terms(make_env, bank):
    env = make_env(4)
    td = act(env, env.reset(), 0.1)
    result = env.last_step
    total = torch.zeros(4, 2)
    for name, value in result.reward_terms.items():
        weight = env.config.rewards[name].get("weight", env.terms.weights[name])
        total += weight * value * (1.0 if name == "failure" else 0.5) / 60
    total *= bank.hand_active[td[keys.MOTION][:, 0]]
    got = torch.cat([td["next", keys.reward(s)] for s in keys.SIDES], -1)
    torch.testing.assert_close(got, total)
    torch.testing.assert_close(
        result.reward_terms["action_l2"], torch.full((4, 2), 0.01)
    )
    idle = ~bank.hand_active[td[keys.MOTION][:, 0]]
    assert not got[idle].any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_wild_actions_do_not_poison(make_env, value):
    env = make_env(4)
    td = env.reset()
    for _ in range(12):
        td, root = env.step_and_maybe_reset(fill(env, td, value))
        for key in (
            keys.JOINT_POS,
            keys.JOINT_VEL,
            keys.OBJECT_POSE,
            keys.JOINT_TARGET,
        ):
            assert torch.isfinite(td["next", key]).all()
        for side in keys.SIDES:
            assert torch.isfinite(td["next", keys.reward(side)]).all()
        td = root


def fill(env, td, value):
    for side in keys.SIDES:
        td.set(keys.action(side), torch.full((env.num_envs, 18), value))
    return td


def test_a_diverged_world_ends_and_the_others_go_on(make_env):
    env = make_env(3, attempt_share=0.0)
    td = env.reset()
    env.physics._qvel[0] = float("nan")
    after = act(env, td)["next"]
    assert after[keys.TERMINATED][0]
    for key in (keys.reward("left"), keys.reward("right")):
        assert torch.isfinite(after[key]).all()
    assert torch.isfinite(after[keys.JOINT_POS][1:]).all()
    td, _ = env.step_and_maybe_reset(fill(env, env.reset(), 0.0))
    assert torch.isfinite(td["next", keys.JOINT_POS]).all()


def test_one_seed_one_run(make_env):
    def run(seed):
        env = make_env(6, seed=seed, assist=AssistConfig(enabled=True))
        td, rows = env.reset(), []
        generator = torch.Generator().manual_seed(9)
        for _ in range(40):
            for side in keys.SIDES:
                draw = 2 * torch.rand(6, 18, generator=generator) - 1
                td.set(keys.action(side), draw)
            td, root = env.step_and_maybe_reset(td)
            rows.append(td)
            td = root
        return torch.stack(rows)

    one, two, other = run(0), run(0), run(1)
    flat, again = (td.flatten_keys(".").to_dict() for td in (one, two))
    assert all(torch.equal(flat[k], again[k]) for k in flat)
    assert not torch.equal(one[keys.JOINT_POS], other[keys.JOINT_POS])
    assert one["next", keys.DONE].any()
