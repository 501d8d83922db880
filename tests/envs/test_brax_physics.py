"""The brax engine against MuJoCo C, on one hand and one box; compiles for a minute."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from reduced import reduced_library
from synthetic import FRIENDLY

from flashdex import keys
from flashdex.envs.physics.brax.engine import BraxPhysics, refuse_unlike_objects
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.errors import FlashdexError

pytest.importorskip("brax", reason="needs the extra 'brax'")

N = 4
ALL = torch.ones(N, dtype=torch.bool)
MOTION = torch.zeros(N, dtype=torch.long)
FIELDS = (keys.JOINT_POS, keys.JOINT_VEL, keys.OBJECT_POSE, keys.OBJECT_VEL)
MASS = 0.12  # kg, of the box


@pytest.fixture(scope="module")
def reduced(tmp_path_factory, hands):
    """Right hand and box."""
    return reduced_library(tmp_path_factory.mktemp("reduced") / "library", hands)


@pytest.fixture(scope="module")
def engines(reduced, hands):
    """Both engines, four worlds each; every test resets all of them."""
    config = PhysicsConfig(num_threads=1, **FRIENDLY)
    build = (BraxPhysics, CpuPhysics)
    return tuple(engine(reduced, hands, config, N) for engine in build)


@pytest.fixture(scope="module")
def start(reduced, hands):
    """Start of each world, in the order of ``reset``, and targets that close the hand.

    World 0: all in the air, the box turns. World 1: box at rest, hand above it. World
    2: open hand around the box. World 3: like 2, from another frame.
    """
    bank = ReferenceBank(reduced, hands)
    ref = bank.at(MOTION, torch.tensor([0, 0, 10, 5]))
    joints, vel = ref["joint_pos"].clone(), torch.zeros(N, 2, 18)
    pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
    spin = torch.zeros(N, 2, 6)
    pose[0, 0, 2] += 8.0  # it falls by 3.4 m
    spin[0, 0] = torch.tensor([0.1, -0.2, 0.5, 1.0, 2.0, -1.0])
    joints[:2, :, 2] += 0.3
    closed = joints.clone()
    closed[:2, :, 6:] *= 0.5
    joints[..., 6:] *= 0.3
    return (joints, vel, pose, spin), closed


def target_at(start, step):
    """Joint targets of control step ``step``: closed after 30 steps."""
    share = min(1.0, step / 30)
    return start[0][0] * (1 - share) + start[1] * share


def run(engine, start, steps):
    """Reset all worlds and step; the states after each step."""
    engine.reset(ALL, MOTION, *start[0])
    states = []
    for step in range(steps):
        engine.step(target_at(start, step))
        states.append(engine.state())
    return torch.stack(states)


@pytest.fixture(scope="module")
def runs(engines, start):
    """Fifty control steps with equal controls in both engines."""
    return tuple(run(engine, start, 50) for engine in engines)


def test_reset_gives_the_state_that_was_asked_for(engines, start):
    brax, cpu = engines
    for engine in engines:
        engine.reset(ALL, MOTION, *start[0])
    got, wanted = brax.state(), cpu.state()
    for key in FIELDS:
        torch.testing.assert_close(got[key], wanted[key], atol=2e-6, rtol=1e-6)
    assert not got["bad"].any()
    torch.testing.assert_close(
        brax.raw().ctrl, cpu.raw().ctrl.float(), atol=1e-6, rtol=0
    )


def test_worlds_without_contact_equal_mujoco(runs):
    # Float32 against float64, 200 substeps. The box has 0.12 kg and 4e-5 kg m2, so that
    # its accelerations keep four digits: seen 7e-4 in the spin, 1e-4 elsewhere.
    got, wanted = (run[:, 0] for run in runs)
    assert wanted[keys.OBJECT_POSE][-1, 0, 2] > 0.5  # still in the air
    assert wanted[keys.JOINT_POS][-1].abs().max() > 0.1
    for key in FIELDS:
        tol = 2e-3 if key == keys.OBJECT_VEL else 3e-4
        torch.testing.assert_close(got[key], wanted[key], atol=tol, rtol=1e-4)


def test_a_resting_box_lies_where_mujoco_lays_it(runs):
    # Four contact points of MJX against those of MuJoCo's general collider.
    got, wanted = (run[keys.OBJECT_POSE][:, 1, 0] for run in runs)
    assert (got[-1] - wanted[-1]).abs().max() < 2e-4
    assert (got[:, :3] - wanted[:, :3]).abs().max() < 2e-3


def test_a_closing_hand_moves_the_box_like_mujoco(runs):
    # MJX has other colliders: depths of the same capsule on the same box differ by
    # some tenths of a millimetre, and a squeezed box turns that into millimetres. Seen
    # over 50 steps: 4 mm, 0.07 in the quaternion, 0.07 rad.
    got, wanted = (run[:, 2:] for run in runs)
    assert wanted[keys.CONTACT][-1, :, 1, :, :3].norm(dim=-1).sum(-1).min() > 1.0
    pose = (got[keys.OBJECT_POSE] - wanted[keys.OBJECT_POSE])[:, :, 0].abs()
    assert pose[..., :3].max() < 0.012
    assert pose[..., 3:].max() < 0.2
    assert (got[keys.JOINT_POS] - wanted[keys.JOINT_POS]).abs().max() < 0.2
    path = wanted[keys.OBJECT_POSE][:, :, 0, :3]
    moved = path[-1] - path[0]
    assert moved.norm(dim=-1).max() > 0.002
    assert not got["bad"].any()


def test_contact_force_is_what_accelerates_the_box(engines, start):
    # Newton for the box in the air, gripped: exact, whatever the collider says.
    brax, _ = engines
    (joints, vel, pose, spin), closed = start
    up = torch.tensor([0.0, 0.0, 0.5])
    joints, pose = closed.clone(), pose.clone()
    joints[2:, :, :3] += up
    pose[2:, 0, :3] += up
    brax.reset(ALL, MOTION, joints, vel, pose, spin)
    before, brax.decimation = brax.state(), 1
    try:
        brax.step(joints)
    finally:
        brax.decimation = 4
    after = brax.state()
    force = -after[keys.CONTACT][2:, 1, :, :3].sum(1)
    assert force.norm(dim=-1).min() > 1.0
    speeds = [mass_centre_speed(s)[2:] for s in (before, after)]
    accel = (speeds[1] - speeds[0]) * 240
    wanted = (force - MASS * torch.tensor([0.0, 0.0, 9.81])) / MASS
    torch.testing.assert_close(accel, wanted, atol=0.05, rtol=5e-3)


def mass_centre_speed(state):
    """Velocity of the box's centre of mass, which lies off its frame, (N, 3)."""
    from flashdex.geometry.rotation import quat_rotate

    pose, vel = state[keys.OBJECT_POSE][:, 0], state[keys.OBJECT_VEL][:, 0]
    lever = quat_rotate(pose[:, 3:], torch.tensor([0.003, -0.002, 0.001]))
    return vel[:, :3] + torch.linalg.cross(vel[:, 3:], lever)


def test_contact_wrench_is_what_the_sensors_of_mujoco_report(engines, start):
    brax, _ = engines
    (_, vel, pose, spin), closed = start
    seen = []
    for engine in engines:
        engine.reset(ALL, MOTION, closed, vel, pose, spin)
        seen.append(engine.state()[keys.CONTACT][:, 1])
    both = (seen[0][..., :3].norm(dim=-1) > 1.0) & (seen[1][..., :3].norm(dim=-1) > 1.0)
    assert both.sum() >= 3
    got, wanted = seen[0][both], seen[1][both]
    # Points on the same faces; a capsule along a face has two contacts in MJX.
    assert (got[:, 3:] - wanted[:, 3:]).norm(dim=-1).max() < 0.012
    cosine = torch.cosine_similarity(got[:, :3], wanted[:, :3], dim=-1)
    assert cosine.min() > 0.9
    assert not seen[0][0].any()  # nothing touches in the air
    assert not brax.state()[keys.CONTACT][:, 0].any()  # there is no left hand


def make_wrench(seed=0, slots=2):
    """Random inputs, some of them beyond the limits."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(N, *shape, generator=g)

    pose = torch.cat([normal(slots, 3), normal(slots, 4)], -1)
    pose[..., 3:] /= pose[..., 3:].norm(dim=-1, keepdim=True)
    root = 0.01 * normal(slots, 3, 3)
    return ObjectWrench(
        ref_pose=pose,
        ref_vel=normal(slots, 6),
        mass=normal(slots).abs(),
        inertia=root @ root.mT,
        present=torch.tensor([[True, True], [True, False]]).repeat(N // 2, 1),
        hold=torch.rand(N, generator=g),
        kp=80 * torch.rand(N, generator=g),
        kv=5 * torch.rand(N, generator=g),
        hold_stiffness=20.0,
        torque_ratio=96.0,
        force_limit=50.0,
        torque_limit=0.05,
    )


def test_wrench_maths_equals_torch():
    import jax

    from flashdex.envs.physics.brax.step import to_jax, to_torch
    from flashdex.envs.physics.brax.wrench import object_wrench, wrench_inputs

    wrench, other = make_wrench(), make_wrench(seed=1)
    wrench.hold[2] = 0.0  # the clamped assist alone
    pose, vel = other.ref_pose, other.ref_vel
    pose[0] = wrench.ref_pose[0]  # no turn at all
    pose[1, :, 3:] = -wrench.ref_pose[1, :, 3:]  # the same turn
    inputs = wrench_inputs(wrench, to_jax)
    axes = (
        inputs._replace(**{**dict.fromkeys(inputs._fields, 0), "limits": None}),
        0,
        0,
    )
    found = jax.vmap(object_wrench, in_axes=axes)(inputs, to_jax(pose), to_jax(vel))
    wanted = wrench(pose, vel)
    assert (wanted.abs() == wrench.torque_limit).any()
    assert not wanted[1, 1].any()
    scale = wanted.abs().clamp_min(1.0)
    assert ((to_torch(found) - wanted) / scale).abs().max() < 1e-5


def test_wrench_acts_before_every_substep_as_in_mujoco(engines, start):
    (joints, vel, pose, spin), _ = start
    pose, spin = pose.clone(), spin.clone()
    pose[:, 0, 2] = 1.5
    wrench = dataclasses.replace(
        make_wrench(),
        ref_vel=torch.zeros(N, 2, 6),
        mass=torch.full((N, 2), MASS),
        inertia=4e-5 * torch.eye(3).expand(N, 2, 3, 3),
        hold_stiffness=5.0,
        torque_ratio=1.0,
        force_limit=2.0,
    )
    ends = []
    for engine in engines:
        engine.reset(ALL, MOTION, joints, vel, pose, spin)
        for _ in range(5):
            engine.step(joints, wrench)
        ends.append((engine.state(), engine.raw().wrench))
    (got, applied), (wanted, wanted_wrench) = ends
    assert wanted_wrench[..., :3].abs().max() > 1.0
    torch.testing.assert_close(applied, wanted_wrench, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(
        got[keys.OBJECT_POSE], wanted[keys.OBJECT_POSE], atol=5e-4, rtol=1e-3
    )


def test_masked_reset_leaves_the_others_bit_for_bit(engines, start):
    brax, _ = engines
    run(brax, start, 20)
    before, raw = brax.state(), brax.raw()
    mask = torch.tensor([False, True, False, True])
    # Rows of the others are ignored, even when there are no numbers in them.
    rows = [torch.where(mask.reshape(-1, 1, 1), x, torch.nan) for x in start[0]]
    brax.reset(mask, MOTION, *rows)
    after = brax.state()
    for key in (*FIELDS, keys.CONTACT, "bad"):
        assert torch.equal(before[key][~mask], after[key][~mask])
    for name in ("qpos", "qvel", "ctrl", "wrench"):
        old, new = getattr(raw, name), getattr(brax.raw(), name)
        assert torch.equal(old[~mask], new[~mask])
    torch.testing.assert_close(after[keys.JOINT_POS][mask, 1], start[0][0][mask, 1])
    brax.reset(torch.zeros(N, dtype=torch.bool), MOTION, *start[0])
    assert torch.equal(brax.raw().qpos, _state_of(after, brax))


def _state_of(state, engine):
    flat = engine.map.write(MOTION, *[state[key] for key in FIELDS])
    return flat[0].float()


def test_worlds_that_break_down_stay_marked_until_their_reset(engines, start):
    brax, _ = engines
    state = [x.clone() for x in start[0]]
    state[3][1, 0, 0] = 1e12
    brax.reset(ALL, MOTION, *state)
    for _ in range(2):
        brax.step(state[0])
    assert brax.state()["bad"].tolist() == [False, True, False, False]
    brax.reset(torch.tensor([False, True, False, False]), MOTION, *start[0])
    assert not brax.state()["bad"].any()
    brax.step(state[0])
    assert not brax.state()["bad"].any()
    assert brax.take_overflow() == {}


def test_shared_memory_is_never_written_behind_the_other_side(engines, start):
    from flashdex.envs.physics.brax.step import to_jax, to_torch

    source = torch.arange(6.0)
    lent = to_jax(source)
    view = to_torch(lent)
    assert view.data_ptr() == to_torch(lent).data_ptr()  # a view, not a copy
    assert view.data_ptr() == lent.unsafe_buffer_pointer()
    source += 100
    assert lent.tolist() == view.tolist() == [0, 1, 2, 3, 4, 5]

    brax, _ = engines
    brax.reset(ALL, MOTION, *start[0])
    target = target_at(start, 3).clone()
    brax.step(target)
    target.fill_(torch.nan)  # JAX may still be at work
    kept, raw = brax.state(), brax.raw()
    held, copies = kept.clone(), raw.qpos.clone()
    raw.qvel.fill_(torch.nan)
    kept["bad"].fill_(True)
    for _ in range(3):
        brax.step(target_at(start, 4))
    assert not brax.state()["bad"].any()
    assert torch.equal(raw.qpos, copies)
    assert all(torch.equal(kept[key], held[key]) for key in FIELDS)


def test_motions_with_other_objects_are_refused(library, hands):
    with pytest.raises(FlashdexError, match="motion 'left_ball' has other objects"):
        BraxPhysics(library, hands, PhysicsConfig(), 2)


def test_motions_of_the_same_objects_are_not_refused(reduced):
    assert refuse_unlike_objects(reduced) is None


@pytest.mark.slow
def test_worlds_without_places_for_contacts_are_noticed(
    reduced, hands, start, monkeypatch
):
    import jax
    from mujoco import mjx

    from flashdex.envs.physics.brax import model as brax_model
    from flashdex.envs.physics.brax import step as brax_step
    from flashdex.envs.physics.brax.step import to_jax
    from flashdex.envs.physics.state_map import StateMap
    from flashdex.envs.scene.scene import build_scenes

    monkeypatch.setattr(brax_model, "CONTACTS_PER_BODY", 1)
    scenes = build_scenes(reduced, hands, PhysicsConfig())
    model = brax_model.build_model(scenes)
    (_, vel, pose, spin), closed = start
    qpos = StateMap(reduced, hands, scenes[0]).write(MOTION, closed, vel, pose, spin)[0]

    def is_full(qpos):
        system = brax_step.system_of(model, 0)
        data = mjx.make_data(model.system).replace(qpos=qpos)
        data = mjx.collision(system, mjx.kinematics(system, data))
        return brax_step.is_full(model, data)

    full = jax.jit(jax.vmap(is_full))(to_jax(qpos))
    assert full.tolist()[0] is False  # in the air
    assert full.tolist()[2:] == [True, True]  # more than two contacts with the box
