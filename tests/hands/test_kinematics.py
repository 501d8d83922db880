"""Torch kinematics against MuJoCo C."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import load_hand
from flashdex.keys import FINGERS, SIDES


def test_kinematics_match_mujoco(make_model, sample_qpos, sites):
    hands, rng = load_hand("xhand"), np.random.default_rng(2)
    kinematics, model = HandKinematics(hands), make_model()
    data, worlds = mujoco.MjData(model), 16
    qpos = np.stack(
        [[sample_qpos(hands[s], rng) for s in SIDES] for _ in range(worlds)]
    )
    qvel = rng.uniform(-3, 3, qpos.shape)
    out = kinematics(torch.tensor(qpos).float(), torch.tensor(qvel).float())
    assert out.batch_size == (worlds, 2)
    for world in range(worlds):
        data.qpos, data.qvel = qpos[world].ravel(), qvel[world].ravel()
        mujoco.mj_forward(model, data)
        for i, side in enumerate(SIDES):
            wanted = mujoco_state(model, data, hands[side], sites)
            for key, value in wanted.items():
                got = out[key][world, i].double().numpy()
                assert got.shape == value.shape
                if key.endswith("quat"):  # q and -q are one rotation
                    value = value * np.sign((got * value).sum(-1, keepdims=True))
                limit = 4e-5 if key.endswith("vel") else 1e-5
                assert np.abs(got - value).max() < limit, key


def mujoco_state(model, data, hand, sites):
    twist = np.zeros(6)

    def velocity(kind, name):
        index = mujoco.mj_name2id(model, kind, name)
        kind = mujoco.mjtObj.mjOBJ_XBODY if kind == mujoco.mjtObj.mjOBJ_BODY else kind
        mujoco.mj_objectVelocity(model, data, kind, index, twist, 0)
        return twist.copy()

    links = [data.body(n) for n in hand.link_names]
    link_twist = np.array(
        [velocity(mujoco.mjtObj.mjOBJ_BODY, n) for n in hand.link_names]
    )
    pads = [f"{hand.side}_pad_{f}" for f in FINGERS]
    pad_twist = np.array([velocity(mujoco.mjtObj.mjOBJ_SITE, n) for n in pads])
    state = {
        "link_pos": np.array([b.xpos for b in links]),
        "link_quat": np.array([b.xquat for b in links]),
        "link_linvel": link_twist[:, 3:],
        "link_angvel": link_twist[:, :3],
        "tip_pos": sites(model, data, hand.side, "pad"),
        "tip_center": sites(model, data, hand.side, "center"),
        "tip_linvel": pad_twist[:, 3:],
    }
    for field in ("pos", "quat", "linvel", "angvel"):
        state[f"wrist_{field}"] = state[f"link_{field}"][0]
    return state


def test_kinematics_without_velocities_give_the_same_poses():
    kinematics = HandKinematics(load_hand("xhand"))
    joint_pos = torch.rand(3, 4, 2, 18, generator=torch.Generator().manual_seed(0))
    poses = kinematics(joint_pos)
    both = kinematics(joint_pos, torch.zeros_like(joint_pos))
    assert "tip_linvel" not in poses
    assert all(torch.equal(poses[k], both[k]) for k in poses.keys())  # noqa: SIM118
    assert both["link_linvel"].abs().max() == 0
