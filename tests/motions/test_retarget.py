import mujoco
import numpy as np
import pytest
import torch

from flashdex.datasets.procedural.reader import procedural
from flashdex.hands.attach import add_hand
from flashdex.hands.collision_spheres import make_spheres
from flashdex.hands.kinematics import HandJacobian, HandKinematics
from flashdex.hands.spec import load_hand
from flashdex.keys import SIDES
from flashdex.motions.align import align
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.retarget.penetration import (
    make_reference_scene,
    measure_penetration,
)
from flashdex.motions.retarget.solver import Retargeter
from flashdex.motions.retarget.targets import make_targets
from flashdex.objects.asset import ObjectSettings, make_object
from flashdex.objects.solid import make_slot_grid


@pytest.fixture(scope="module")
def specs():
    return load_hand("xhand")


@pytest.fixture(scope="module")
def model(specs):
    scene = mujoco.MjSpec()
    for side in SIDES:
        add_hand(scene, specs[side])
    return scene.compile()


def random_state(specs, seed):
    rng = np.random.default_rng(seed)
    ranges = np.stack([specs[s].joint_range for s in SIDES])
    q = rng.uniform(ranges[..., 0], ranges[..., 1])
    q[:, :6] = rng.uniform(-1, 1, (2, 6))
    return q


def test_jacobian_is_that_of_mujoco(specs, model):
    data = mujoco.MjData(model)
    kinematics, jacobian = HandKinematics(specs).double(), HandJacobian(specs)
    link = torch.as_tensor(specs["left"].tip_link)
    local = torch.tensor(np.stack([specs[s].tip_pos for s in SIDES]))
    for seed in range(5):
        q = random_state(specs, seed)
        data.qpos[:] = q.ravel()
        mujoco.mj_forward(model, data)
        state = torch.tensor(q)[None]
        pose = kinematics(state)
        frames = jacobian.frames(state, pose["link_pos"], pose["link_quat"])
        world = frames.points(link, local)
        full = frames.full(world, link)
        for hand, side in enumerate(SIDES):
            for f, name in enumerate(("thumb", "index", "middle", "ring", "pinky")):
                site = model.site(f"{side}_pad_{name}").id
                wanted = np.zeros((3, model.nv))
                mujoco.mj_jacSite(model, data, wanted, None, site)
                mine = wanted[:, 18 * hand : 18 * hand + 18]
                np.testing.assert_allclose(full[0, hand, f], mine, atol=1e-6)
                position = data.site_xpos[site]
                np.testing.assert_allclose(world[0, hand, f], position, atol=1e-6)


def test_spheres_stay_inside_the_collision_geoms(specs):
    spheres = make_spheres(specs)
    assert spheres.pos.shape == (2, len(spheres.link), 3)
    for hand, side in enumerate(SIDES):
        model = mujoco.MjSpec.from_string(specs[side].mjcf).compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for link, local, radius in zip(
            spheres.link, spheres.pos[hand], spheres.radius, strict=True
        ):
            body = int(link) + 1
            world = data.xmat[body].reshape(3, 3) @ local.numpy() + data.xpos[body]
            assert _depth(model, data, body, world) >= float(radius) - 2e-4


def _depth(model, data, body, point):
    """How deep a point is inside the best geom of a body: closed forms."""
    best = -np.inf
    for geom in np.flatnonzero(model.geom_bodyid == body):
        local = data.geom_xmat[geom].reshape(3, 3).T @ (point - data.geom_xpos[geom])
        size = model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            depth = (size - np.abs(local)).min()
        else:
            gap = max(abs(local[2]) - size[1], 0.0)
            depth = size[0] - np.linalg.norm([local[0], local[1], gap])
        best = max(best, depth)
    return best


@pytest.fixture(scope="module")
def solved(specs, tmp_path_factory):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    aligned = find_roles(align(demo, control_hz=20.0))
    settings = ObjectSettings(sdf_resolution=48)
    cache = tmp_path_factory.mktemp("cache")
    asset = make_object(aligned.meshes[0], settings=settings, cache_dir=cache)
    retargeter = Retargeter(specs)
    targets = make_targets(aligned, retargeter.hand)
    result = retargeter.solve(targets, make_slot_grid([asset], solid=True))
    return aligned, asset, targets, result


def test_reference_respects_joint_limits(specs, solved):
    joint_pos = solved[3].joint_pos
    for hand, side in enumerate(SIDES):
        low, high = specs[side].joint_range.T
        assert (joint_pos[:, hand] >= low).all()
        assert (joint_pos[:, hand] <= high).all()


def test_tips_follow_the_human_and_pads_press_by_two_millimetres(specs, solved, model):
    aligned, asset, targets, result = solved
    assert np.median(result.tip_error[:, 1]) < 0.008
    assert np.quantile(result.tip_error[:, 1], 0.95) < 0.02
    scene = make_reference_scene(specs, [asset.parts])
    depth = measure_penetration(
        scene, result.joint_pos, aligned.poses, active=aligned.active
    )
    held = (targets.contact[:, 1, :3] == 1).all(dim=1).numpy()
    assert held.sum() > 20
    assert np.abs(depth.objects[held] - 0.002).max() < 0.001
    away = (targets.contact[:, 1] == 0).all(dim=1).numpy()
    assert depth.objects[away].max() < 0.0005
    assert depth.table.max() == 0.0


def test_every_touching_finger_is_at_the_surface(specs, solved):
    aligned, _, targets, result = solved
    kinematics = HandKinematics(specs).double()
    center = kinematics(torch.tensor(result.joint_pos))["tip_center"][:, 1].numpy()
    half = np.asarray(aligned.meshes[0].extents) / 2
    pose = aligned.poses[0]
    for t in np.flatnonzero((targets.contact[:, 1, :4] == 1).all(dim=1)):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, pose[t, 3:])
        local = np.abs((center[t] - pose[t, :3]) @ turn.reshape(3, 3)) - half
        outside = np.linalg.norm(np.maximum(local, 0), axis=1)
        distance = outside + np.minimum(local.max(axis=1), 0)  # to a box, closed form
        gap = distance - specs["right"].tip_radius
        assert np.abs(gap[:4] + 0.002).max() < 0.0015


def test_penetration_of_a_known_pose(specs):
    block = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    scene = make_reference_scene(specs, [[block]])
    joint_pos = np.zeros((2, 2, 18))
    joint_pos[:, 0, 2] = 2.0
    joint_pos[:, 1, :3] = [3.0, 3.0, 2.0]
    pose = np.tile([3.0, 3.0, 0, 1, 0, 0, 0.0], (2, 1))
    reach = 0.0342 + 0.0083 + 0.1082 + 0.0558  # of the middle finger below the base
    pose[1, 2] = 2.0 - reach + 0.004 - 0.5  # the top face, 4 mm above that tip
    both = np.array([True, True])
    depth = measure_penetration(scene, joint_pos, [pose], active=both)
    assert depth.objects[0] == 0.0
    assert depth.objects[1] == pytest.approx(0.004, abs=5e-4)
    alone = measure_penetration(scene, joint_pos, [pose], active=~both)
    assert alone.objects.max() == 0.0
