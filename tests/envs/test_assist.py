"""Assist wrench against numpy, and its schedule (method sections 11 and 21)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flashdex.envs.mdp.assist import AssistConfig, AssistSchedule
from flashdex.envs.scene.wrench import ObjectWrench

GOOD = {"task": 1.0, "imitation": 1.0, "cloning": 1.0, "completion": 1.0}


def pose_of(pos, turn):
    return torch.tensor(np.concatenate([pos, np.roll(turn.as_quat(), 1, -1)], -1))


def wrench(pose, vel, ref_pose, ref_vel, inertia, kp, kv, limit=50.0):
    acting = ObjectWrench(
        ref_pose=ref_pose[None, None].float(),
        ref_vel=torch.as_tensor(ref_vel)[None, None].float(),
        mass=torch.ones(1, 1),
        inertia=torch.as_tensor(inertia)[None, None].float(),
        present=torch.ones(1, 1, dtype=torch.bool),
        hold=torch.zeros(1),
        kp=torch.tensor([kp]),
        kv=torch.tensor([kv]),
        hold_stiffness=0.0,
        torque_ratio=96.0,
        force_limit=limit,
        torque_limit=limit,
    )
    vel = torch.as_tensor(vel)[None, None].float()
    return acting.pull(pose[None, None].float(), vel)[0, 0].numpy()


@pytest.mark.parametrize("seed", range(5))
def test_wrench_is_the_closed_form(seed):
    rng = np.random.default_rng(seed)
    turn, ref_turn = (
        Rotation.random(random_state=rng),
        Rotation.random(random_state=rng),
    )
    pos, ref_pos = rng.normal(size=(2, 3)) * 0.1
    vel, ref_vel = rng.normal(size=(2, 6))
    root = rng.normal(size=(3, 3)) * 0.01
    inertia, kp, kv = root @ root.T, 80.0, 5.0
    force = kp * (ref_pos - pos) + kv * (ref_vel[:3] - vel[:3])
    world = turn.as_matrix() @ inertia @ turn.as_matrix().T
    accel = 96 * kp * (ref_turn * turn.inv()).as_rotvec()
    accel = accel + np.sqrt(96) * kv * (ref_vel[3:] - vel[3:])
    got = wrench(
        pose_of(pos, turn), vel, pose_of(ref_pos, ref_turn), ref_vel, inertia, kp, kv
    )
    np.testing.assert_allclose(got[:3], force.clip(-50, 50), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        got[3:], (world @ accel).clip(-50, 50), rtol=2e-4, atol=1e-4
    )


def test_each_component_is_clamped():
    far, one = pose_of([10.0, -10.0, 0.1], Rotation.identity()), Rotation.identity()
    turned = pose_of([0.0, 0.0, 0.0], Rotation.from_rotvec([1.0, 0, 0]))
    zero = np.zeros(6)
    got = wrench(pose_of(np.zeros(3), one), zero, far, zero, np.eye(3), 80.0, 5.0)
    np.testing.assert_allclose(got[:3], [50, -50, 8], rtol=1e-5)
    got = wrench(pose_of(np.zeros(3), one), zero, turned, zero, np.eye(3), 80.0, 5.0)
    np.testing.assert_allclose(got[3:], [50, 0, 0], atol=1e-4)


def run(schedule, epochs, **means):
    """Epochs at which the gains changed."""
    return [schedule.epoch for _ in range(epochs) if schedule.end_epoch(**GOOD | means)]


def test_earliest_zero_is_epoch_2900_after_71_decays():
    schedule = AssistSchedule(AssistConfig(enabled=True))
    changes = run(schedule, 2899)
    assert schedule.active
    assert changes[:3] == [100, 140, 180]
    assert run(schedule, 1) == [2900]
    assert not schedule.active
    assert len(changes) + 1 == 71
    assert run(schedule, 200) == []


def test_levels_fall_by_a_tenth_and_the_draw_widens():
    schedule = AssistSchedule(AssistConfig(enabled=True))
    kp, kv = schedule.draw(50, torch.Generator().manual_seed(0))
    assert (kp == 80).all()
    assert (kv == 5).all()
    run(schedule, 140)
    assert schedule.upper == pytest.approx((64.8, 4.05))
    assert schedule.lower == pytest.approx((51.84, 3.24))
    kp, kv = schedule.draw(500, torch.Generator().manual_seed(0))
    assert 51.84 <= kp.min() < 54 < 63 < kp.max() <= 64.8
    torch.testing.assert_close(kp / kv, torch.full((500,), 16.0))


@pytest.mark.parametrize(
    "gate", [{"task": 0.59}, {"imitation": 0.0}, {"cloning": 0.0}, {"completion": 0.64}]
)
def test_every_gate_is_needed(gate):
    schedule = AssistSchedule(AssistConfig(enabled=True))
    assert run(schedule, 300, **gate) == []
    # means are over 30 epochs, so the poor ones have to leave the window first
    assert 300 < run(schedule, 60)[0] <= 331


def test_dial_back_pops_one_level_and_restarts_the_cooldown():
    schedule = AssistSchedule(AssistConfig(enabled=True, dial_back=True))
    run(schedule, 180)
    before = schedule.upper
    assert before == pytest.approx((80 * 0.9**3, 5 * 0.9**3))
    changes = run(schedule, 1000, completion=0.3)
    assert changes[0] == 180 + 501
    assert len(changes) == 1
    assert schedule.upper == pytest.approx((80 * 0.81 * 0.98, 5 * 0.81 * 0.98))
    assert schedule.lower == pytest.approx(
        (80 * 0.81 * 0.8 * 0.98, 5 * 0.81 * 0.8 * 0.98)
    )


def test_a_decay_after_a_dial_back_waits_for_the_cooldown():
    schedule = AssistSchedule(
        AssistConfig(enabled=True, dial_back=True, window_epochs=1)
    )
    run(schedule, 140)
    assert run(schedule, 501, completion=0.0) == [641]
    assert run(schedule, 50)[0] == 641 + 40


def test_dial_back_on_an_empty_stack_does_nothing():
    schedule = AssistSchedule(AssistConfig(enabled=True, dial_back=True))
    assert run(schedule, 2000, completion=0.0) == []
    assert schedule.upper == (80.0, 5.0)


def test_dial_back_is_off_by_default():
    schedule = AssistSchedule(AssistConfig(enabled=True))
    run(schedule, 140)
    assert run(schedule, 2000, completion=0.3) == []


def test_state_dict_continues_the_schedule():
    one = AssistSchedule(AssistConfig(enabled=True))
    run(one, 205, task=0.7)
    two = AssistSchedule(AssistConfig(enabled=True))
    two.load_state_dict(one.state_dict())
    assert run(one, 400) == run(two, 400)
    assert one.upper == two.upper
