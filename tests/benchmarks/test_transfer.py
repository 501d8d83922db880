"""Replays under other settings: the model is the one that would have been built."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from pushed_box import make_rollout

from benchmarks import transfer
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.scene.scene import build_scenes
from flashdex.rollouts.resimulation import load_simulation

FIELDS = ("geom_friction", "body_gravcomp", "body_mass")


@pytest.fixture(scope="module")
def sim(library, hands):
    """A simulation in the careful world whose controls nobody plays."""
    scene = build_scenes(library, hands, PhysicsConfig())[0]
    rollout = replace(make_rollout(), decimation=4)
    made = load_simulation(make_rollout())
    bodies = [scene.model.body(f"object{s}").id for s in range(2)]
    parts = {"rollout": rollout, "model": scene.model}
    return replace(made, **parts, object_body=np.array(bodies))


@pytest.mark.parametrize("world", ["careful", "friendly", "hard"])
def test_a_changed_model_is_the_one_that_is_built(sim, world, library, hands):
    setting = transfer.worlds()[f"world={world}"]
    physics = PhysicsConfig(**setting, decimation=8 if world == "hard" else 4)
    built = build_scenes(library, hands, physics)[0].model
    found = transfer.change(sim, setting)
    assert found.rollout.decimation == physics.decimation
    assert found.model.opt.timestep == pytest.approx(built.opt.timestep, rel=1e-5)
    assert found.model.opt.solver == built.opt.solver
    solid = sim.model.geom_rbound != 1e-3  # grains fill unused places
    for field in FIELDS:
        ours, theirs = getattr(found.model, field), getattr(built, field)
        rows = solid if field.startswith("geom") else slice(None)
        np.testing.assert_allclose(ours[rows], theirs[rows], err_msg=field)


def test_friction_of_a_pair_is_the_larger_of_two(sim):
    for wanted in (2.0, 0.8, 0.3):
        model = transfer.change(sim, {"hand_object": wanted}).model
        hand = model.geom("right_palm0").friction[0]
        assert max(hand, model.geom("object0_part0").friction[0]) == wanted
    assert mujoco.mjtSolver(sim.model.opt.solver).name == "mjSOL_NEWTON"  # untouched


def test_a_rollout_passes_as_it_was_made(tmp_path):
    rollout = make_rollout()
    rollout.save(tmp_path / "rollouts" / "push.npz")
    rows = transfer.measure(tmp_path, {"same": {}, "slippery": {"hand_object": 0.0}})
    assert rows["rollouts"] == 1
    assert rows["rows"]["same"]["sr_mt_obj"] == 1
    assert rows["rows"]["same"]["passing"] == [rollout.motion]
    assert "same" in transfer.table(rows)
