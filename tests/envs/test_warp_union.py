"""The union of a collection's scenes: what a motion lacks is absent from its worlds."""

from __future__ import annotations

import dataclasses
import sys

import mujoco
import numpy as np
import pytest
import torch
from synthetic import HALF, LENGTHS, make_ball, make_box, make_frames

from flashdex import keys
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.reference import ReferenceBank
from flashdex.errors import FlashdexError, MissingExtraError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import LibraryWriter, MotionRecord

pytest.importorskip("mujoco_warp")

MOTIONS = torch.arange(3)


@pytest.fixture(scope="module")
def uneven(tmp_path_factory, hands):
    """A box of two parts, a ball of one, and the ball without the support."""
    box, ball = make_box(), make_ball()
    halves = [box.parts[0].copy(), box.parts[0].copy()]
    for half, sign in zip(halves, (1, -1), strict=True):
        half[half[:, 0] * sign < 0, 0] = 0.0
    assert [np.ptp(h[:, 0]) for h in halves] == pytest.approx([HALF[0]] * 2)
    box.parts[:] = halves
    disc, none = np.full((4, 5), np.nan), np.full((4, 5), np.nan)
    disc[0] = [0.0, 0.0, 0.0, 0.8, 0.02]
    path = tmp_path_factory.mktemp("uneven") / "library"
    writer = LibraryWriter(path, hand="xhand", fps=60.0)
    active, owner, length = (False, True), (-1, 0), LENGTHS["right_box"]
    for name, item, discs in (("a", box, disc), ("b", ball, disc), ("c", ball, none)):
        frames = make_frames(hands, length, active, owner, [item])
        writer.add(MotionRecord(name, frames, active, owner, [item], discs))
    return MotionLibrary.load(writer.write())


@pytest.fixture(scope="module")
def union(uneven, hands):
    """The union of the uneven collection, with all that warp reads."""
    from flashdex.envs.physics.warp.model import model_fields
    from flashdex.envs.scene.scene import build_scenes
    from flashdex.envs.scene.union import build_union

    scenes = build_scenes(uneven, hands, PhysicsConfig())
    return build_union(uneven, hands, PhysicsConfig(), scenes, model_fields())


def start(bank, motion, frame):
    ref = bank.at(motion, frame)
    pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
    spin = torch.cat([ref["object_linvel"], ref["object_angvel"]], -1)
    return motion, ref["joint_pos"], ref["joint_vel"], pose, spin


def touching(engine, env):
    """Pairs of geoms in contact in one world."""
    data = engine.data
    count = int(data.nacon.numpy()[0])
    mine = data.contact.worldid.numpy()[:count] == env
    pairs = data.contact.geom.numpy()[:count][mine]
    return sorted({tuple(sorted(p)) for p in pairs.tolist()})


@pytest.mark.parametrize("count", [3, 1])
def test_absent_parts_and_supports_touch_nothing(uneven, hands, count):
    """Also in a single world, of which warp would not ask what is absent."""
    from flashdex.envs.physics.warp.engine import WarpPhysics

    bank = ReferenceBank(uneven, hands)
    warp = WarpPhysics(uneven, hands, PhysicsConfig(), count)
    motion = MOTIONS[-count:]
    everywhere = torch.ones(count, dtype=torch.bool)
    for frame in (0, 20):
        state = start(bank, motion, motion * 0 + frame)
        warp.reset(everywhere, *state)
        for env, m in enumerate(motion.tolist()):
            model = warp.scenes[m].model
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = warp.raw().qpos[env], warp.raw().qvel[env]
            mujoco.mj_forward(model, data)
            wanted = sorted({tuple(sorted(p)) for p in data.contact.geom.tolist()})
            grains = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
            real = [p for p in wanted if not set(p) & set(grains.tolist())]
            assert touching(warp, env) == real
            support, second = model.geom("support0").id, model.geom("object0_part1").id
            touched = {g for pair in real for g in pair}
            assert m == 0 or second not in touched
            assert not (m == 2 and support in touched)


def test_an_object_without_a_support_falls_as_on_the_cpu_engine(uneven, hands):
    from flashdex.envs.physics.warp.engine import WarpPhysics

    bank, everywhere = ReferenceBank(uneven, hands), torch.ones(3, dtype=torch.bool)
    warp = WarpPhysics(uneven, hands, PhysicsConfig(), 3)
    cpu = CpuPhysics(uneven, hands, PhysicsConfig(num_threads=1), 3)
    motion, joints, vel, pose, spin = start(bank, MOTIONS, MOTIONS * 0)
    joints[..., 2] += 1.0  # hands away
    for engine in (warp, cpu):
        engine.reset(everywhere, motion, joints, vel * 0, pose, spin * 0)
        for _ in range(10):
            engine.step(joints)
    got, wanted = (e.state()[keys.OBJECT_POSE][:, 0, :3] for e in (warp, cpu))
    torch.testing.assert_close(got, wanted, atol=1e-4, rtol=0)
    fall = (pose[:, 0, 2] - got[:, 2]).tolist()
    assert fall[:2] == pytest.approx([0, 0], abs=2e-3)
    assert fall[2] > 0.1


def test_rows_are_those_of_the_compiled_scenes(union, uneven, hands):
    model = union.model
    part, support = model.geom("object0_part1").id, model.geom("support0").id
    assert union.rows["geom_dataid"][:, part].tolist()[1:] == [-1, -1]
    assert union.rows["geom_dataid"][0, part] >= 0
    assert union.rows["geom_size"][:2, support, 0].tolist() == pytest.approx([0.8] * 2)
    assert union.rows["geom_pos"][2, support, 2] < -10
    mass = union.rows["body_mass"][:, model.body("object0").id]
    assert mass.tolist() == pytest.approx([0.12, 0.09, 0.09])
    assert "jnt_range" not in union.rows


def test_what_worlds_cannot_have_of_their_own_is_refused(union):
    from flashdex.envs.physics.warp.model import WorldRows, room_of

    rows = {**union.rows, "geom_condim": np.stack([union.model.geom_condim] * 3)}
    room = room_of(union.model, PhysicsConfig())
    with pytest.raises(FlashdexError, match=r"geom_condim differ.*engine=cpu"):
        WorldRows(dataclasses.replace(union, rows=rows), 3, room, "cpu")


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    from flashdex.envs.physics.warp.model import require_warp

    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(MissingExtraError, match=r"mujoco_warp.*extra 'warp'"):
        require_warp()
