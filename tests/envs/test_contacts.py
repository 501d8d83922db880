"""Contact sensors against MuJoCo's contact list; idle hands and empty slots."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from engine_states import raw_state

from flashdex import keys


def contact_sums(model, data, hand, slot):
    """Force of the object on each link and its weighted point, by brute force."""
    thing = model.body(f"object{slot}").id
    force, point = np.zeros((2, len(hand.link_names), 3))
    weight = np.zeros(len(hand.link_names))
    links = {model.body(n).id: i for i, n in enumerate(hand.link_names)}
    for i in range(data.ncon):
        contact = data.contact[i]
        bodies = [int(model.geom_bodyid[g]) for g in contact.geom]
        if thing not in bodies or not links.keys() & set(bodies):
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        # the force of the first geom on the second, contact frame rows are axes
        world = contact.frame.reshape(3, 3).T @ wrench[:3]
        sign = 1.0 if bodies[0] == thing else -1.0
        link = links[bodies[1] if bodies[0] == thing else bodies[0]]
        size = np.linalg.norm(wrench[:3])
        force[link] += sign * world
        point[link] += size * contact.pos
        weight[link] += size
    touched = weight > 0
    point[touched] /= weight[touched, None]
    return force, point, touched


def test_sensor_is_the_sum_of_contacts_with_the_own_object(make_env, hands, bank):
    env = make_env(3, evaluation=True)
    env.forced_motion = torch.tensor([0, 1, 2])
    env.reset()
    physics = env.physics
    twins = [mujoco.MjData(physics.scene(world).model) for world in range(3)]
    for world, data in enumerate(twins):
        data.qpos[:], data.qvel[:], _ = raw_state(physics, world)
    generator = torch.Generator().manual_seed(0)
    touching = crowded = 0
    for frame in range(1, 26):
        target = bank.at(env.motion, torch.full((3,), frame))["joint_pos"]
        physics.step(target + 0.1 * torch.randn(target.shape, generator=generator))
        got = physics.state()[keys.CONTACT].numpy()
        for world, data in enumerate(twins):
            model = physics.scene(world).model
            data.ctrl[:] = raw_state(physics, world)[2]
            for _ in range(physics.decimation):
                mujoco.mj_step(model, data)  # contacts of the last substep stay in data
            for side, name in enumerate(keys.SIDES):
                if not bank.hand_active[world, side]:
                    assert not got[world, side].any()
                    continue
                slot = int(bank.hand_slot[world, side])
                force, point, touched = contact_sums(model, data, hands[name], slot)
                ours = got[world, side]
                np.testing.assert_allclose(ours[:, :3], force, atol=1e-4, rtol=1e-5)
                np.testing.assert_allclose(ours[touched, 3:], point[touched], atol=1e-5)
                assert not ours[~touched, :3].any()
                touching += int(touched.sum())
                crowded += int(data.ncon > touched.sum())
    assert touching > 60
    assert crowded > 10  # other contacts were there, and did not count


@pytest.mark.parametrize("side", [0, 1])
def test_idle_hand_and_empty_slot_stay_put_untouched(make_physics, bank, side):
    physics = make_physics(1)
    motion = torch.tensor([1 - side])  # motion 0 uses the right hand only, 1 the left
    ref = bank.at(motion, motion * 0)
    pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
    physics.reset(
        torch.ones(1, dtype=torch.bool),
        motion,
        ref["joint_pos"],
        ref["joint_vel"],
        pose,
        pose[..., :6] * 0,
    )
    scene, name = physics.scene(0), keys.SIDES[1 - side]
    assert not bank.hand_active[int(motion), 1 - side]
    hand, empty = scene.joint_qpos(name), scene.object_qpos(1) + np.arange(7)
    first = raw_state(physics, 0)[0]
    data = mujoco.MjData(scene.model)
    bodies = {scene.model.body(n).id for n in scene.hands[name].link_names}
    bodies.add(scene.model.body("object1").id)
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        noise = 0.1 * torch.randn(1, 2, 18, generator=generator)
        physics.step(ref["joint_pos"] + noise)
        data.qpos[:] = raw_state(physics, 0)[0]
        mujoco.mj_forward(scene.model, data)
        touching = {
            int(scene.model.geom_bodyid[g]) for c in data.contact for g in c.geom
        }
        assert not touching & bodies
    last = raw_state(physics, 0)[0]
    np.testing.assert_allclose(last[hand], first[hand], atol=1e-3)
    np.testing.assert_allclose(last[empty], first[empty], atol=1e-3)
    state = physics.state()
    assert not state[keys.JOINT_POS][0, 1 - side].any()
    assert not state[keys.CONTACT][0, 1 - side].any()
