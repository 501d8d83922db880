"""Servos and gravity compensation against closed forms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from flashdex.hands.spec import load_hand

LARGE, SMALL = 1.1, 0.4
# effort of the finger motors, in joint order, N m
EFFORT = np.array([LARGE, LARGE, SMALL, SMALL] + [LARGE, SMALL] * 4)


@pytest.mark.parametrize("gravcomp", [1.0, 0.5, 0.0])
def test_gravity_compensation_leaves_the_uncompensated_sag(
    gravcomp, make_model, sample_qpos
):
    rng = np.random.default_rng(4)
    hand = load_hand("xhand")["right"]
    model = make_model("right", gravcomp=gravcomp, contact=False)
    data = mujoco.MjData(model)
    data.qpos = sample_qpos(hand, rng)
    data.qpos[3:6] *= 0.2
    start = data.ctrl[:] = data.qpos.copy()
    for _ in range(960):
        mujoco.mj_step(model, data)
    # the z slide carries the hand and the three virtual links after it
    sag = (1.0 - gravcomp) * (1.122385 + 0.3) * 9.81 / 350.0
    assert start[2] - data.qpos[2] == pytest.approx(sag, abs=1e-4)
    if gravcomp == 1.0:
        assert data.qpos == pytest.approx(start, abs=1e-4)


def step_response(model, hand, joint, seconds):
    """Trace of one joint from a quarter to three quarters of its way, as 0 to 1."""
    data = mujoco.MjData(model)
    lower, upper = (0.0, 0.2) if joint < 6 else hand.joint_range[joint]
    data.qpos[6:] = hand.joint_range[6:].mean(-1)
    start, goal = lower + np.array([0.25, 0.75]) * (upper - lower)
    data.qpos[joint] = start
    data.ctrl[:] = data.qpos
    data.ctrl[joint] = goal
    trace = []
    for _ in range(int(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        trace.append(data.qpos[joint])
    return (np.array(trace) - start) / (goal - start)


@pytest.mark.parametrize("preset", ["paper", "vendor"])
def test_step_response_settles_without_ringing(preset, make_model):
    hand = load_hand("xhand")["left"]
    model = make_model("left", gains=preset, contact=False)
    for joint in range(3, 18):
        trace = step_response(model, hand, joint, 4.0)
        assert trace.max() < 1.1, hand.joint_names[joint]
        # dry friction of the vendor preset leaves friction / kp, about 0.013 rad
        assert trace[-1] == pytest.approx(1.0, abs=0.12), hand.joint_names[joint]
        assert np.ptp(trace[-60:]) < 1e-3, hand.joint_names[joint]


def test_wrist_slide_overshoot_is_that_of_the_second_order_system(make_model):
    hand = load_hand("xhand")["left"]
    model = make_model("left", contact=False, timestep=1 / 2000)
    for joint, links in ((0, 5), (1, 4), (2, 3)):
        mass = 1.122254 + 0.1 * links + 0.1
        zeta = (15.0 + 1.0) / (2.0 * np.sqrt(350.0 * mass))
        overshoot = np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2))
        trace = step_response(model, hand, joint, 3.0)
        assert trace.max() - 1.0 == pytest.approx(overshoot, abs=0.01)
        assert trace[-1] == pytest.approx(1.0, abs=1e-3)


def test_finger_servos_are_held_to_the_motor_effort(make_model):
    model = make_model("right", gains="vendor")
    effort = EFFORT
    assert model.actuator_forcerange[6:] == pytest.approx(np.outer(effort, [-1, 1]))
    data = mujoco.MjData(model)
    data.ctrl[6:] = 1.5
    mujoco.mj_step(model, data)
    assert np.all(np.abs(data.actuator_force[6:]) <= effort + 1e-9)
    assert np.abs(data.actuator_force[6:]).max() == pytest.approx(LARGE)


def test_paper_gains(make_model):
    model = make_model("right")
    kp = [350.0] * 3 + [60.0] * 3 + [20.0] * 12
    kv = [15.0] * 3 + [3.0] * 3 + [1.5] * 12
    assert model.actuator_gainprm[:, 0] == pytest.approx(kp)
    assert -model.actuator_biasprm[:, 1] == pytest.approx(kp)
    assert -model.actuator_biasprm[:, 2] == pytest.approx(kv)
    assert model.dof_damping == pytest.approx(np.ones(18))
    assert model.dof_armature == pytest.approx(np.full(18, 0.1))


def test_vendor_fingers_are_critically_damped(make_model):
    model = make_model("right", gains="vendor")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((18, 18))
    mujoco.mj_fullM(model, data, inertia)
    kp, kv = model.actuator_gainprm[6:, 0], -model.actuator_biasprm[6:, 2]
    ratio = kv / (2.0 * np.sqrt(kp * np.diag(inertia)[6:]))
    assert ratio == pytest.approx(np.ones(12), abs=0.03)
