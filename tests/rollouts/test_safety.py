"""Penetration, force, limits, deviation and perturbations against closed forms."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from flashdex.envs.scene.perturbation import (
    Perturbation,
    control_range,
    perturb_objects,
)
from flashdex.rollouts.resimulation import load_simulation, perturb, resimulate
from flashdex.rollouts.safety import (
    SafetyMonitor,
    geom_kinds,
    joint_limit_violations,
    normal_forces,
    state_deviation,
)


def settle(xml, steps=2000):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return model, data


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_normal_forces_agree_with_mujoco_and_carry_the_weight(scene_xml, cone):
    model, data = settle(scene_xml.replace('cone="elliptic"', f'cone="{cone}"'))
    expected = []
    for i in range(data.ncon):
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        expected.append(wrench[0])
    force = normal_forces(model, data)
    np.testing.assert_allclose(force, expected, atol=1e-12)
    assert force.sum() == pytest.approx(0.3 * 9.81, rel=1e-3)


def test_penetration_of_a_settling_box_is_how_deep_it_sinks(build_rollout):
    rollout = build_rollout(push=0.0)
    sim = load_simulation(rollout)
    monitor = SafetyMonitor(sim.model, sim.object_body)
    resimulate(sim, monitor=monitor)
    report = monitor.to_dict()
    # oracle: a flat box is as deep as its centre is below half its height
    model = mujoco.MjModel.from_xml_string(rollout.model_xml)
    data = mujoco.MjData(model)
    heights = []
    for _ in range(4 * rollout.num_frames):
        heights.append(data.qpos[3])
        mujoco.mj_step(model, data)
    depth_mm = (0.03 - min(heights)) * 1e3
    assert depth_mm > 0.1
    assert report["penetration_object_support_mm"] == pytest.approx(depth_mm, rel=1e-3)
    assert report["penetration_hand_object_mm"] == 0.0
    assert report["penetration_max_mm"] == report["penetration_object_support_mm"]
    assert 0.2 < report["force_peak_ratio"] < 2.0
    assert report["force_peak"] == pytest.approx(
        report["force_peak_ratio"] * 0.3 * 9.81
    )


def test_first_pose_inside_the_box_shows_as_hand_penetration(rollout):
    sim = load_simulation(rollout)
    monitor = SafetyMonitor(sim.model, sim.object_body)
    qpos0 = rollout.qpos0.copy()
    # palm face at -.10 + q, box face at -.03
    qpos0[0] = 0.07 + 0.004
    resimulate(replace(sim, qpos0=qpos0), monitor=monitor)
    # the tip's sphere is 5 mm ahead of the palm
    assert monitor.peaks["penetration_hand_object"] == pytest.approx(0.009, rel=0.05)
    assert monitor.peaks["force_ratio"] > 1.0


def test_geoms_are_sorted_into_object_hand_and_support(rollout):
    sim = load_simulation(rollout)
    assert geom_kinds(sim.model, sim.object_body).tolist() == [-2, -1, -1, 0]


def test_joint_limits_count_samples_beyond_the_tolerance(rollout):
    model = load_simulation(rollout).model  # slide, range -.05 to .6
    qpos = np.tile(rollout.qpos0, (4, 1))
    qpos[:, 0] = [0.6, 0.6005, 0.602, -0.07]
    report = joint_limit_violations(model, qpos)
    assert report["count"] == 2
    assert report["max_m"] == pytest.approx(0.02)
    assert report["max_rad"] == 0.0


def test_deviation_measures_every_kind_of_joint(rollout):
    model = load_simulation(rollout).model
    stored = np.tile(rollout.qpos0, (3, 1))
    changed = stored.copy()
    changed[1, 0] += 0.002
    changed[2, 1:4] += [0.003, 0.004, 0.0]
    changed[2, 4:8] = [np.cos(0.15), 0, np.sin(0.15), 0]
    changed[1, 4:8] *= -1  # the same rotation
    shift, turn = state_deviation(model, changed, stored)
    np.testing.assert_allclose(shift, [0, 0.002, 0.005], atol=1e-12)
    np.testing.assert_allclose(turn, [0, 0, 0.3], atol=1e-12)


def test_perturbed_poses_stay_within_their_sizes(rollout):
    sim, sizes = load_simulation(rollout), Perturbation()
    shifts, turns = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        qpos = perturb_objects(sim.qpos0, sim.object_adr, rng, sizes)
        assert qpos[0] == rollout.qpos0[0]  # the hand is left alone
        shifts.append(np.abs(qpos[1:4] - rollout.qpos0[1:4]).max())
        turns.append(2 * np.arccos(np.clip(abs(qpos[4]), 0, 1)))
        assert np.linalg.norm(qpos[4:8]) == pytest.approx(1.0)
    assert 0.0019 < max(shifts) <= 0.002
    assert np.radians(1.9) < max(turns) <= np.radians(2.0) + 1e-9


def test_perturbed_masses_friction_and_controls(rollout):
    sim = load_simulation(rollout)
    mass, friction, noise = [], [], []
    for index in range(60):
        changed = perturb(sim, seed=0, index=index)
        body = sim.object_body[0]
        factor = changed.model.body_mass[body] / sim.model.body_mass[body]
        inertia = changed.model.body_inertia[body] / sim.model.body_inertia[body]
        np.testing.assert_allclose(inertia, factor)
        assert changed.model.body_mass[1] == sim.model.body_mass[1]
        ratio = changed.model.geom_friction / sim.model.geom_friction
        assert np.ptp(ratio) < 1e-12
        mass.append(factor)
        friction.append(ratio[0, 0])
        noise.append(changed.ctrl - rollout.ctrl)
    for factors in (mass, friction):
        assert 0.8 <= min(factors) < 0.85
        assert 1.15 < max(factors) <= 1.2
    # the slide may travel .65 m, of which .4 m count
    assert np.std(noise) == pytest.approx(0.005 * 0.4, rel=0.05)
    assert sim.model.body_mass[sim.object_body[0]] == 0.3


def test_solver_weights_follow_the_mass(rollout):
    sim = load_simulation(rollout)
    changed = perturb(sim, seed=0, index=0)
    body = sim.object_body[0]
    product = changed.model.body_mass[body] * changed.model.body_invweight0[body, 0]
    expected = sim.model.body_mass[body] * sim.model.body_invweight0[body, 0]
    assert product == pytest.approx(expected)


def test_range_of_an_actuator(rollout, scene_xml):
    settings = Perturbation(ctrl_range_m=10.0)
    model = mujoco.MjModel.from_xml_string(scene_xml)
    assert control_range(model, rollout.ctrl, settings) == pytest.approx([0.65])
    own = scene_xml.replace('kp="400"', 'kp="400" ctrlrange="0 .2"')
    model = mujoco.MjModel.from_xml_string(own)
    assert control_range(model, rollout.ctrl, settings) == pytest.approx([0.2])
    free = mujoco.MjModel.from_xml_string(scene_xml.replace('range="-.05 .6"', ""))
    assert control_range(free, rollout.ctrl, settings) == pytest.approx([0.25])
    assert control_range(free, rollout.ctrl, Perturbation(ctrl_range_m=0.1)) == 0.1
