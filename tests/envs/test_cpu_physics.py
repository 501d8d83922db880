"""The cpu engine against plain MuJoCo C."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from engine_states import raw_state, reset_worlds
from scipy.spatial.transform import Rotation

from flashdex import keys

FIELDS = ("joint_pos", "joint_vel", "object_pose", "object_vel")


def start(bank, motion, frame):
    """Reference states of motions (n,) as arguments of ``reset``."""
    ref = bank.at(motion, frame)
    return {
        "joint_pos": ref["joint_pos"],
        "joint_vel": ref["joint_vel"],
        "object_pose": torch.cat([ref["object_pos"], ref["object_quat"]], -1),
        "object_vel": torch.cat([ref["object_linvel"], ref["object_angvel"]], -1),
    }


@pytest.fixture
def running(make_physics, bank):
    """Six worlds, two a motion, in the middle of their motions, and random targets."""
    physics = make_physics(6, num_threads=2)
    motion = torch.tensor([0, 1, 2, 2, 1, 0])
    frame = torch.tensor([5, 10, 15, 20, 25, 30])
    reset_worlds(physics, torch.arange(6), motion, start(bank, motion, frame))
    generator = torch.Generator().manual_seed(0)
    base = bank.at(motion, frame)["joint_pos"]

    def targets():
        return base + 0.2 * torch.randn(base.shape, generator=generator)

    return physics, targets


def test_equals_a_plain_loop_bit_for_bit(running):
    physics, targets = running
    models = [physics.scene(env).model for env in range(6)]
    data = [mujoco.MjData(m) for m in models]
    for env, d in enumerate(data):
        d.qpos[:], d.qvel[:], _ = raw_state(physics, env)
    touched = 0
    for _ in range(200):
        physics.step(targets())
        for env, d in enumerate(data):
            qpos, qvel, d.ctrl[:] = raw_state(physics, env)
            for _ in range(physics.decimation):
                mujoco.mj_step(models[env], d)
            assert (qpos == d.qpos).all()
            assert (qvel == d.qvel).all()
            touched += d.ncon
    assert touched > 1000


def test_wrench_form_equals_the_plain_form_when_it_is_zero(make_physics, bank):
    one, two = make_physics(3), make_physics(3)
    motion = torch.arange(3)
    for physics in (one, two):
        state = start(bank, motion, torch.full((3,), 8))
        reset_worlds(physics, torch.arange(3), motion, state)
    target = bank.at(motion, torch.full((3,), 12))["joint_pos"]
    for _ in range(20):
        one.step(target)
        two.step(target, lambda pose, vel: torch.zeros(3, 2, 6))
    for env in range(3):
        for a, b in zip(raw_state(one, env), raw_state(two, env), strict=True):
            assert (a == b).all()


def test_wrench_acts_on_the_object_in_world_axes(make_physics, bank, library):
    physics, motion = make_physics(1), torch.tensor([2])
    state = start(bank, motion, torch.tensor([0]))
    state["object_pose"][0, :, 2] = 0.6  # in the air, away from the hands
    state["object_vel"][:] = 0
    reset_worlds(physics, torch.arange(1), motion, state)
    wrench = torch.zeros(1, 2, 6)
    wrench[0, 0] = torch.tensor([0.3, 0.0, 0.12 * 9.81, 0.0, 0.0, 0.0])
    wrench[0, 1] = torch.tensor([0.0, -0.2, 0.09 * 9.81, 0.0, 0.0, 1e-4])
    physics.step(bank.at(motion, motion * 0)["joint_pos"], lambda pose, vel: wrench)
    vel, dt = physics.state()[keys.OBJECT_VEL][0], physics.step_dt
    masses = library.objects["mass"]
    assert vel[1, 1].item() == pytest.approx(-0.2 / float(masses[1]) * dt, rel=1e-2)
    spin = 1e-4 / float(library.objects["inertia"][1, 2, 2]) * dt
    assert vel[1, 5].item() == pytest.approx(spin, rel=1e-2)
    assert vel[0, 0].item() == pytest.approx(0.3 / float(masses[0]) * dt, rel=1e-2)
    assert abs(vel[0, 2].item()) < 1e-2


def test_resetting_some_worlds_leaves_the_others_alone(running, bank):
    physics, targets = running
    for _ in range(5):
        physics.step(targets())
    before = [raw_state(physics, env) for env in range(6)]
    ids, motion = torch.tensor([1, 4]), torch.tensor([2, 0])
    reset_worlds(physics, ids, motion, start(bank, motion, torch.tensor([3, 4])))
    for env in (0, 2, 3, 5):
        for old, new in zip(before[env], raw_state(physics, env), strict=True):
            assert (old == new).all()
    got, wanted = physics.state(), start(bank, motion, torch.tensor([3, 4]))
    for side, world, row in ((0, 1, 0), (1, 1, 0), (1, 4, 1)):
        for key in ("joint_pos", "joint_vel"):
            torch.testing.assert_close(got[key][world, side], wanted[key][row, side])
    assert not got[keys.JOINT_POS][4, 0].any()  # the left hand has no part there
    assert got[keys.OBJECT_POSE][4, 1].tolist() == [0, 0, 0, 1, 0, 0, 0]


def test_worlds_do_not_depend_on_their_neighbours(running, bank):
    physics, targets = running
    rows = [targets() for _ in range(30)]
    start_state = [raw_state(physics, env) for env in range(6)]
    for target in rows:
        physics.step(target)
    free = [raw_state(physics, env)[0] for env in range(6)]
    motion, frame = torch.tensor([0, 1, 2, 2, 1, 0]), torch.arange(5, 35, 5)
    reset_worlds(physics, torch.arange(6), motion, start(bank, motion, frame))
    for env in range(6):
        assert (raw_state(physics, env)[0] == start_state[env][0]).all()
    for step, target in enumerate(rows):
        if step == 10:
            ids = torch.tensor([1, 2])
            reset_worlds(physics, ids, ids, start(bank, ids, ids * 0))
        physics.step(target)
    for env in (0, 3, 4, 5):
        assert (raw_state(physics, env)[0] == free[env]).all()


@pytest.mark.parametrize("motion", [0, 1, 2])
def test_state_round_trip_with_world_spin(make_physics, bank, motion):
    physics, rows = make_physics(1), torch.tensor([motion])
    state = start(bank, rows, torch.tensor([7]))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    state["object_pose"][..., 3:] = torch.tensor(np.roll(turn.as_quat(), 1)).float()
    state["object_vel"] = torch.randn(
        1, 2, 6, generator=torch.Generator().manual_seed(4)
    )
    reset_worlds(physics, torch.arange(1), rows, state)
    got, scene = physics.state(), physics.scene(0)
    qvel = raw_state(physics, 0)[1]
    for slot in range(2):
        if bank.object_index[motion, slot] < 0:
            assert not got[keys.OBJECT_VEL][0, slot].any()
            continue
        vel = state["object_vel"][0, slot].numpy()
        torch.testing.assert_close(
            got[keys.OBJECT_VEL][0, slot], torch.tensor(vel), atol=1e-6, rtol=1e-5
        )
        body = qvel[scene.object_dof(slot) + 3 :][:3]
        np.testing.assert_allclose(body, turn.inv().apply(vel[3:]), atol=1e-6)


def test_spin_is_what_mujoco_says_in_world_axes(running):
    physics, targets = running
    for _ in range(20):
        physics.step(targets())
    vel = physics.state()[keys.OBJECT_VEL]
    for env, slot in ((0, 0), (1, 0), (2, 0), (2, 1)):
        model = physics.scene(env).model
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], _ = raw_state(physics, env)
        mujoco.mj_forward(model, data)
        out, body = np.zeros(6), model.body(f"object{slot}").id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, out, 0)
        np.testing.assert_allclose(vel[env, slot], np.roll(out, 3), atol=1e-4)


def test_bad_numbers_are_reported_until_the_reset(make_physics, bank):
    physics, motion = make_physics(3), torch.arange(3)
    state = start(bank, motion, motion * 0)
    reset_worlds(physics, torch.arange(3), motion, state)
    physics._qvel[1] = 1e12
    for _ in range(3):
        physics.step(state["joint_pos"])
    assert physics.state()["bad"].tolist() == [False, True, False]
    one = torch.tensor([1])
    reset_worlds(physics, one, one, start(bank, one, one * 0))
    assert not physics.state()["bad"].any()
    physics.step(state["joint_pos"])
    assert not physics.state()["bad"].any()
    assert all(torch.isfinite(physics.state()[key]).all() for key in FIELDS)
