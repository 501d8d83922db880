"""The warp engine on the CPU device: against the cpu engine, and against itself."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from no_sync import forbid_sync
from synthetic import FRIENDLY

from flashdex import keys
from flashdex.envs.scene.wrench import ObjectWrench

pytest.importorskip("mujoco_warp")

STATE = (keys.JOINT_POS, keys.JOINT_VEL, keys.OBJECT_POSE, keys.OBJECT_VEL)
MOTIONS = torch.arange(3)
FRAMES = torch.tensor([5, 10, 15])


@pytest.fixture(scope="module")
def make_warp(library, hands):
    """Build the warp engine: worlds, then fields of PhysicsConfig."""
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.warp.engine import WarpPhysics

    def make(num_envs, **fields):
        return WarpPhysics(
            library, hands, PhysicsConfig(**FRIENDLY, **fields), num_envs
        )

    return make


@pytest.fixture(scope="module")
def trio(make_warp):
    """One world a motion; every test resets them."""
    return make_warp(3)


@pytest.fixture(scope="module")
def start(bank):
    """Reference states of motions (n,) at frames (n,) as arguments of ``reset``."""

    def make(motion, frame):
        ref = bank.at(motion, frame)
        return {
            "motion": motion,
            "joint_pos": ref["joint_pos"],
            "joint_vel": ref["joint_vel"],
            "object_pose": torch.cat([ref["object_pos"], ref["object_quat"]], -1),
            "object_vel": torch.cat([ref["object_linvel"], ref["object_angvel"]], -1),
        }

    return make


@pytest.fixture(scope="module")
def targets(bank):
    """Random targets around the start states of the three motions, (50, 3, 2, J)."""
    base = bank.at(MOTIONS, FRAMES)["joint_pos"]
    noise = torch.randn(50, *base.shape, generator=torch.Generator().manual_seed(0))
    return base + 0.2 * noise


def everywhere(physics):
    return torch.ones(physics.num_envs, dtype=torch.bool)


def run(physics, targets):
    """Step and return qpos and qvel after the last step."""
    for target in targets:
        physics.step(target)
    raw = physics.raw()
    return raw.qpos.clone(), raw.qvel.clone()


def make_wrench(start, bank, **fields):
    """A wrench with every part at work, three worlds."""
    ref, rows = start(MOTIONS, FRAMES + 4), bank.object_index[MOTIONS].clamp_min(0)
    values = {
        "ref_pose": ref["object_pose"],
        "ref_vel": ref["object_vel"],
        "mass": bank.mass[rows],
        "inertia": bank.inertia[rows],
        "present": bank.object_index >= 0,
        "hold": torch.tensor([0.0, 0.4, 1.0]),
        "kp": torch.tensor([80.0, 20.0, 0.0]),
        "kv": torch.tensor([5.0, 0.0, 1.0]),
        "hold_stiffness": 40.0,
        "torque_ratio": 96.0,
        "force_limit": 0.5,
        "torque_limit": 0.02,
    }
    return ObjectWrench(**{**values, **fields})


@pytest.fixture(scope="module")
def cpu_like(library, hands):
    """The cpu engine, one thread, as many substeps as the warp engine."""
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.cpu import CpuPhysics

    def make(num_envs):
        config = PhysicsConfig(num_threads=1, **FRIENDLY)
        return CpuPhysics(library, hands, config, num_envs)

    return make


@pytest.mark.parametrize("frame", [0, 20])
def test_reset_gives_the_states_and_contacts_of_the_cpu_engine(
    trio, cpu_like, start, frame
):
    other, state = cpu_like(3), start(MOTIONS, MOTIONS * 0 + frame)
    for physics in (trio, other):
        physics.reset(everywhere(physics), **state)
    got, wanted = trio.state(), other.state()
    for key in STATE:
        torch.testing.assert_close(got[key], wanted[key], atol=1e-6, rtol=1e-6)
    force = wanted[keys.CONTACT]
    assert force.abs().max() > 1.0
    torch.testing.assert_close(got[keys.CONTACT], force, atol=2e-2, rtol=1e-3)
    assert not got["bad"].any()


def test_a_control_step_equals_the_cpu_engine(trio, cpu_like, start, targets):
    """From 50 states each: float32, except where a contact has one point or two.

    Whether an edge of the ball's mesh touches with one point or with two hangs on an
    angle of 5 degrees, which float32 and float64 decide differently.
    """
    cpu, error, force = cpu_like(3), [], []
    cpu.reset(everywhere(cpu), **start(MOTIONS, FRAMES))
    for target in targets:
        state = cpu.state()
        trio.reset(everywhere(trio), MOTIONS, *[state[k] for k in STATE])
        for physics in (trio, cpu):
            physics.step(target)
        error.append((trio.raw().qpos - cpu.raw().qpos).abs().amax(-1))
        a, b = (p.state()[keys.CONTACT][..., :3] for p in (trio, cpu))
        force.append((a - b).abs().amax((1, 2, 3)))
    error, force = torch.stack(error), torch.stack(force)
    assert error[:, 0].max() < 5e-5  # the box: 4.7e-6 measured
    assert error.median(0).values.max() < 5e-5  # 4.5e-6
    assert error.max() < 0.05  # 7e-3
    assert force.median(0).values.max() < 0.1  # N, of forces up to 80 N


def test_the_box_moves_as_on_the_cpu_engine_for_200_substeps(
    trio, cpu_like, start, targets
):
    """The error grows from 1e-8 m to about 1e-5 m; perturbed C grows tenfold too."""
    cpu = cpu_like(3)
    for physics in (trio, cpu):
        physics.reset(everywhere(physics), **start(MOTIONS, FRAMES))
        run(physics, targets)
    got, wanted = trio.state(), cpu.state()
    gap = (got[keys.OBJECT_POSE] - wanted[keys.OBJECT_POSE])[..., :3].abs()
    travel = wanted[keys.OBJECT_POSE] - start(MOTIONS, FRAMES)["object_pose"]
    assert travel[0, 0, :3].norm() > 5e-3  # it was pushed
    assert gap[0].max() < 1e-3
    assert gap.max() < 0.3  # the balls: chaotic, but still here
    assert torch.isfinite(got[keys.JOINT_POS]).all()


def rows_of(physics, name):
    return getattr(physics.model, name).shape[0]


def test_each_motion_moves_as_its_own_model_does(trio, start, targets):
    """The swap against mujoco_warp on the compiled scene itself, 50 substeps."""
    import mujoco_warp as mjw
    import warp as wp

    from flashdex.envs.physics.warp.model import model_fields

    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    # Kernels are compiled for the number of rows: with as many they are the same.
    own = [n for n, each in model_fields().items() if each and rows_of(trio, n) == 3]
    alone = []
    for env, scene in enumerate(trio.scenes):
        host = mujoco.MjModel.from_xml_string(scene.xml)
        host.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        model = mjw.put_model(host, batch_sizes=dict.fromkeys(own, 3))
        model.opt.warn_overflow = 0
        data = mjw.make_data(host, nworld=1, nconmax=128, njmax=512)
        wp.to_torch(data.qpos).copy_(trio.raw().qpos[env : env + 1])
        wp.to_torch(data.qvel).copy_(trio.raw().qvel[env : env + 1])
        alone.append((model, data))
    for target in targets[:3]:
        trio.step(target)
        for env, (model, data) in enumerate(alone):
            wp.to_torch(data.ctrl).copy_(trio.raw().ctrl[env : env + 1])
            for _ in range(trio.decimation):
                mjw.step(model, data)
    for env, (_, data) in enumerate(alone):
        got, wanted = trio.raw().qpos[env], wp.to_torch(data.qpos)[0]
        torch.testing.assert_close(got, wanted, atol=1e-5, rtol=0)


@pytest.mark.parametrize("motion", [0, 1, 2])
def test_a_world_does_not_depend_on_the_motions_beside_it(trio, start, targets, motion):
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    qpos, qvel = run(trio, targets)
    same, rows = torch.full((3,), motion), targets[:, [motion] * 3]
    trio.reset(everywhere(trio), **start(same, FRAMES[same]))
    got = run(trio, rows)
    assert torch.equal(got[0][motion], qpos[motion])
    assert torch.equal(got[1][motion], qvel[motion])


def test_a_single_world_equals_one_of_many(trio, make_warp, start, targets):
    """Up to float32: the solver adds up in an order that depends on the worlds."""
    solo = make_warp(1)
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    qpos = run(trio, targets[:3])[0]
    for motion in (0, 2):
        one = slice(motion, motion + 1)
        solo.reset(everywhere(solo), **start(MOTIONS[one], FRAMES[one]))
        got = run(solo, targets[:3, one])[0]
        torch.testing.assert_close(got[0], qpos[motion], atol=5e-5, rtol=0)  # 6e-6


def test_a_swapped_world_equals_a_fresh_engine(make_warp, trio, start, targets):
    swapped, frame = MOTIONS.roll(1), FRAMES.roll(1)
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    run(trio, targets[:5])
    fresh = make_warp(3)
    for physics in (trio, fresh):
        physics.reset(everywhere(physics), **start(swapped, frame))
    got, wanted = run(trio, targets[:20]), run(fresh, targets[:20])
    assert torch.equal(got[0], wanted[0])
    assert torch.equal(got[1], wanted[1])


def test_a_masked_reset_leaves_the_others_untouched(trio, start, targets):
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    whole = run(trio, targets[:20])
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    run(trio, targets[:10])
    before, mask = trio.state(), torch.tensor([False, True, False])
    state = start(MOTIONS.roll(1), MOTIONS * 0 + 3)
    state["joint_pos"][0] = torch.nan  # rows of other worlds are not read
    trio.reset(mask, **state)
    for key in (*STATE, keys.CONTACT):
        assert torch.equal(trio.state()[key][~mask], before[key][~mask])
    assert not torch.equal(trio.state()[keys.CONTACT][1], before[keys.CONTACT][1])
    qpos, qvel = run(trio, targets[10:20])
    assert torch.equal(qpos[~mask], whole[0][~mask])
    assert torch.equal(qvel[~mask], whole[1][~mask])


def test_recorded_steps_equal_launched_ones(make_warp, start, targets, bank, caplog):
    """The first call of each kind launches, later ones replay; neither warns."""
    recorded, plain = make_warp(3), make_warp(3)
    wrench = make_wrench(start, bank)
    for physics in (recorded, plain):
        physics.reset(everywhere(physics), **start(MOTIONS, FRAMES))
    for i, target in enumerate(targets[:12]):
        pull = wrench if i % 3 == 0 else None
        recorded.step(target, pull)
        for call in (plain._step_free, plain._step_pulled):
            call._calls = 0
        plain.step(target, pull)
    assert recorded._step_free._graph is not None
    assert recorded._step_pulled._graph is not None
    assert plain._step_free._graph is None
    assert torch.equal(recorded.raw().qpos, plain.raw().qpos)
    assert torch.equal(recorded.raw().wrench, plain.raw().wrench)
    assert "could not be recorded" not in caplog.text


@pytest.mark.parametrize("seed", [0, 1])
def test_the_wrench_kernel_is_the_torch_function(trio, start, bank, seed):
    generator = torch.Generator().manual_seed(seed)
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    raw = trio.raw()
    raw.qvel.copy_(torch.randn(raw.qvel.shape, generator=generator))
    wrench = make_wrench(start, bank)
    flip = torch.where(torch.rand(3, 2, 1, generator=generator) < 0.5, -1.0, 1.0)
    wrench.ref_pose[..., 3:] *= flip
    state = trio.state()
    wanted = wrench(state[keys.OBJECT_POSE], state[keys.OBJECT_VEL])
    trio._wrench.copy(wrench)
    trio._wrench.launch()
    torch.testing.assert_close(raw.wrench, wanted, atol=1e-5, rtol=1e-5)
    assert wanted.abs().max() > 1.0
    assert not raw.wrench[0, 1].any()  # an empty slot
    for slot in range(2):
        body = trio.scenes[0].model.body(f"object{slot}").id
        assert torch.equal(trio._xfrc[:, body], raw.wrench[:, slot])


def test_the_wrench_acts_as_on_the_cpu_engine(trio, cpu_like, start, bank, targets):
    cpu, wrench = cpu_like(3), make_wrench(start, bank)
    for physics in (trio, cpu):
        physics.reset(everywhere(physics), **start(MOTIONS, FRAMES))
        physics.step(targets[0], wrench)
    got, wanted = trio.state(), cpu.state()
    for key, error in ((keys.OBJECT_POSE, 1e-4), (keys.OBJECT_VEL, 2e-2)):
        torch.testing.assert_close(got[key], wanted[key], atol=error, rtol=1e-3)
    torch.testing.assert_close(trio.raw().wrench, cpu.raw().wrench, atol=1e-2, rtol=0)
    trio.step(targets[1])
    assert not trio.raw().wrench.any()
    assert not trio._xfrc.any()


def test_a_broken_world_is_marked_alone_and_recovers(trio, start, targets):
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    whole = run(trio, targets[:10])
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    trio.raw().qvel[1, 3] = torch.nan
    qpos, qvel = run(trio, targets[:10])
    assert trio.state()["bad"].tolist() == [False, True, False]
    assert trio.take_overflow() == {}
    assert torch.equal(qpos[[0, 2]], whole[0][[0, 2]])
    assert torch.equal(qvel[[0, 2]], whole[1][[0, 2]])
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    assert not trio.state()["bad"].any()
    again = run(trio, targets[:10])
    assert torch.equal(again[0], whole[0])
    assert torch.equal(again[1], whole[1])


@pytest.mark.parametrize("value", [1e12, -torch.inf])
def test_bad_is_sticky_until_the_reset(trio, start, targets, value):
    trio.reset(everywhere(trio), **start(MOTIONS, FRAMES))
    trio.raw().qpos[2, 0] = value
    trio.step(targets[0])
    trio.raw().qpos.copy_(torch.nan_to_num(trio.raw().qpos, 0.0, 0.0, 0.0).clamp(-1, 1))
    trio.raw().qvel.zero_()
    assert trio.state()["bad"].tolist() == [False, False, True]
    mask = torch.tensor([True, False, True])
    trio.reset(mask, **start(MOTIONS, FRAMES))
    assert not trio.state()["bad"].any()


@pytest.mark.parametrize(
    ("fields", "kind"), [({"nconmax": 3}, "contacts"), ({"njmax": 30}, "constraints")]
)
def test_overflow_is_reported_once_and_survives_resets(
    make_warp, start, targets, fields, kind, capfd
):
    physics = make_warp(2, **fields)
    two = start(MOTIONS[1:], FRAMES[1:])
    physics.reset(everywhere(physics), **two)
    run(physics, targets[:3, 1:])
    physics.reset(everywhere(physics), **two)
    assert physics.take_overflow().get(kind, 0) >= 1
    assert physics.take_overflow() == {}
    assert "overflow" not in capfd.readouterr().out


def test_room_follows_the_scene_unless_it_is_named(trio, make_warp):
    """30 hand geoms and 2 parts move, condim 4; 36 joints have limits, 24 friction."""
    assert trio.data.naconmax == 3 * 4 * 32
    assert trio.data.naccdmax == 3 * 2 * 32
    assert trio.data.njmax == 4 * 4 * 32 + 36 + 24
    named = make_warp(2, nconmax=70, njmax=90).data
    assert (named.naconmax, named.njmax) == (140, 90)


def test_no_call_waits_for_the_device(trio, start, bank, targets):
    state, wrench = start(MOTIONS, FRAMES), make_wrench(start, bank)
    mask = torch.tensor([True, False, True])
    for _ in range(2):
        with forbid_sync():
            trio.reset(mask, **state)
            trio.step(targets[0])
            trio.step(targets[1], wrench)
            found = trio.state()
            trio.raw()
    assert not found["bad"].any()


def test_the_guard_sees_what_waits():
    flags, values = torch.tensor([True, False]), torch.arange(2.0)
    waits = [
        lambda: values[0].item(),
        lambda: bool(flags.any()),
        lambda: flags.nonzero(),
        lambda: values[flags],
        lambda: values.masked_select(flags),
    ]

    def assign():
        values[flags] = values[:1] * 2

    for call in (*waits, assign):
        with pytest.raises(AssertionError, match="waits"), forbid_sync():
            call()
    with forbid_sync():
        torch.where(flags, values, 0.0)


def test_the_union_has_the_meshes_and_settings_of_every_scene(trio):
    """Rows, options, hull graphs; vertices are checked when the union is built."""
    host, option = trio.scenes[0].model, trio.model.opt
    assert option.iterations == host.opt.iterations
    assert option.ls_iterations == host.opt.ls_iterations
    assert option.cone == host.opt.cone
    assert option.solver == host.opt.solver
    assert option.integrator == host.opt.integrator
    assert option.timestep.numpy()[0] == np.float32(host.opt.timestep)
    inverse = option.impratio_invsqrt.numpy()[0]
    assert inverse == pytest.approx(host.opt.impratio**-0.5)
    assert (trio.model.mesh_graphadr.numpy() >= 0).all()
    for env, scene in enumerate(trio.scenes):
        np.testing.assert_array_equal(
            trio.model.body_mass.numpy()[env], np.float32(scene.model.body_mass)
        )
