"""Scenes of a collection: one layout, faithful objects, self-contained text."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import Batch

from flashdex import keys

SIZES = ("nq", "nv", "nu", "nbody", "njnt", "ngeom", "nsite", "nsensordata", "nbvh")


def test_all_scenes_share_a_layout(scenes):
    for size in SIZES:
        assert len({getattr(s.model, size) for s in scenes}) == 1, size
    batch = Batch(scenes[0].model, nsim=6, nthread=1)
    batch.set_models([s.model for s in scenes] * 2)
    batch.step(nstep=3)
    assert np.isfinite(batch.bind("qpos")).all()


def test_addresses_are_the_same_in_every_scene(scenes):
    first = scenes[0]
    for scene in scenes[1:]:
        for side in keys.SIDES:
            for name in ("joint_qpos", "joint_dof", "joint_actuator", "contact_sensor"):
                ours, theirs = getattr(scene, name)(side), getattr(first, name)(side)
                assert (ours == theirs).all()
        assert scene.object_qpos(1) == first.object_qpos(1)


def test_text_alone_rebuilds_the_model(scenes):
    for scene in scenes:
        again = mujoco.MjModel.from_xml_string(scene.xml)
        sizes = [mujoco.mj_sizeModel(m) for m in (again, scene.model)]
        bytes_ = [np.zeros(s, np.uint8) for s in sizes]
        mujoco.mj_saveModel(again, None, bytes_[0])
        mujoco.mj_saveModel(scene.model, None, bytes_[1])
        assert (bytes_[0] == bytes_[1]).all()
        assert "file=" not in scene.xml


@pytest.mark.parametrize(("motion", "slot"), [(0, 0), (1, 0), (2, 0), (2, 1)])
def test_mass_and_inertia_are_those_of_the_library(scenes, library, motion, slot):
    model = scenes[motion].model
    row = int(library.motions["object_index"][motion, slot])
    asset, body = library.objects[row], model.body(f"object{slot}")
    assert body.mass[0] == pytest.approx(float(asset["mass"]), rel=1e-6)
    np.testing.assert_allclose(body.ipos, asset["com"].numpy(), atol=2e-5)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    turn = turn.reshape(3, 3)
    inertia = turn @ np.diag(body.inertia) @ turn.T
    np.testing.assert_allclose(inertia, asset["inertia"].numpy(), rtol=1e-4, atol=1e-9)


def test_supports_stand_at_their_height(scenes):
    for scene in scenes:
        geom = scene.model.geom("support0")
        assert geom.type[0] == mujoco.mjtGeom.mjGEOM_CYLINDER
        top = geom.pos[2] + geom.size[1]
        assert top == pytest.approx(0.0, abs=1e-7)
        assert geom.size[0] == pytest.approx(0.8)


def test_contact_bits(scenes):
    model = scenes[2].model
    collides = [g for g in range(model.ngeom) if model.geom_contype[g]]

    def kind(geom):
        name = model.body(model.geom_bodyid[geom]).name
        return name.split("_")[0]

    def meet(a, b):
        one = model.geom_contype[a] & model.geom_conaffinity[b]
        return bool(one | (model.geom_contype[b] & model.geom_conaffinity[a]))

    hand = next(g for g in collides if kind(g) == "left")
    other = next(g for g in collides if kind(g) == "right")
    thing = next(g for g in collides if kind(g) == "object0")
    second = next(g for g in collides if kind(g) == "object1")
    support = model.geom("support0").id
    for a, b in ((hand, other), (hand, thing), (thing, second), (thing, support)):
        assert meet(a, b)
    assert meet(hand, support)


def test_hands_pass_through_supports_when_asked(library, hands):
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.scene.scene import build_scenes

    config = PhysicsConfig(hand_support_contact=False)
    model = build_scenes(library, hands, config)[0].model
    support, part = model.geom("support0"), model.geom("object0_part0")
    assert support.conaffinity[0] & 1 == 0
    assert support.contype[0] == 0
    assert part.contype[0] & support.conaffinity[0]


def test_layout_of_a_one_handed_collection_has_one_hand(library, hands):
    from dataclasses import replace

    from flashdex.envs.scene.scene import SceneLayout

    only = replace(library, motions=library.motions[torch.tensor([0])])
    layout = SceneLayout.of(only)
    assert layout.sides == ("right",)
    assert (layout.num_objects, layout.num_parts, layout.num_supports) == (1, (1,), 1)


def test_friction_and_solver_are_those_of_the_settings(library, hands):
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.scene.scene import build_scenes

    physics = PhysicsConfig(friction=0.9, object_friction=0.4, support_friction=0.6)
    model = build_scenes(library, hands, physics)[0].model
    expected = {"right": 0.9, "left": 0.9, "object": 0.4, "support": 0.6}
    for word, sliding in expected.items():
        names = [n for i in range(model.ngeom) if (n := model.geom(i).name)]
        rows = [model.geom(n) for n in names if n.startswith(word)]
        solid = [g for g in rows if g.size[0] != 1e-3]  # grains fill unused places
        assert solid
        for geom in solid:
            np.testing.assert_allclose(geom.friction, [sliding, 0.005, 1e-4])
    solvers = {"newton": "NEWTON", "cg": "CG", "pgs": "PGS"}
    for word, name in solvers.items():
        model = build_scenes(library, hands, PhysicsConfig(solver=word))[0].model
        assert mujoco.mjtSolver(model.opt.solver).name == f"mjSOL_{name}"
