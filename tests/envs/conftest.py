"""Random compact states, and what MuJoCo says of them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from flashdex import keys
from flashdex.envs.transforms.contact import encode_contact

FINGERS = keys.FINGERS


@pytest.fixture
def make_state(library, bank, hands):
    """Random compact states of one motion near its objects, batch (n,)."""

    def make(n, *, motion=2, seed=0):
        g = torch.Generator().manual_seed(seed)

        def uniform(*shape, low=-1.0, high=1.0):
            return low + (high - low) * torch.rand(*shape, generator=g)

        ranges = torch.stack(
            [torch.as_tensor(hands[s].joint_range) for s in keys.SIDES]
        )
        low, high = ranges.float().unbind(-1)
        joints = low + (high - low) * torch.rand(n, 2, 18, generator=g)
        joints[..., :3] = uniform(n, 2, 3) * 0.1
        joints[..., 3:6] = uniform(n, 2, 3) * 2.5
        quat = torch.nn.functional.normalize(torch.randn(n, 2, 4, generator=g), dim=-1)
        force = torch.randn(n, 2, 13, 3, generator=g) * 3
        force *= torch.rand(n, 2, 13, 1, generator=g) < 0.5
        length = int(library.motions["length"][motion])
        frame = torch.randint(1, length, (n, 1), generator=g)
        state = {
            keys.JOINT_POS: joints,
            keys.JOINT_VEL: torch.randn(n, 2, 18, generator=g),
            keys.JOINT_TARGET: joints + 0.1 * uniform(n, 2, 18),
            keys.OBJECT_POSE: torch.cat([uniform(n, 2, 3) * 0.15, quat], -1),
            keys.OBJECT_VEL: torch.randn(n, 2, 6, generator=g),
            keys.CONTACT: encode_contact(force, uniform(n, 2, 13, 3) * 0.05),
            keys.MOTION: torch.full((n, 1), motion),
            keys.FRAME: frame,
            keys.ATTEMPT: torch.zeros(n, 1, dtype=torch.bool),
        }
        return TensorDict(state, batch_size=[n])

    return make


@pytest.fixture(scope="session")
def scenes(library, hands):
    """Compiled scenes of the three motions."""
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.scene.scene import build_scenes

    return build_scenes(library, hands, PhysicsConfig())


@pytest.fixture
def robot(scenes):
    """Poses and velocities of one hand from MuJoCo, world frame, float64."""
    scene = scenes[2]
    model, data = scene.model, mujoco.MjData(scene.model)

    def read(state, row, side):
        data.qpos[:], data.qvel[:] = model.qpos0, 0
        for i, name in enumerate(keys.SIDES):
            data.qpos[scene.joint_qpos(name)] = state[keys.JOINT_POS][row, i].double()
            data.qvel[scene.joint_dof(name)] = state[keys.JOINT_VEL][row, i].double()
        mujoco.mj_forward(model, data)
        hand = scene.hands[keys.SIDES[side]]
        links = [model.body(n).id for n in hand.link_names]
        pads = [model.site(f"{hand.prefix}pad_{f}").id for f in FINGERS]
        centres = [model.site(f"{hand.prefix}center_{f}").id for f in FINGERS]
        body, site = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_SITE
        link_vel = np.array([velocity(model, data, body, i) for i in links])
        tip_vel = np.array([velocity(model, data, site, i) for i in pads])
        return {
            "wrist_pos": data.xpos[links[0]].copy(),
            "wrist": data.xmat[links[0]].reshape(3, 3).copy(),
            "wrist_vel": link_vel[0],
            "link_pos": data.xpos[links].copy(),
            "link": data.xmat[links].reshape(-1, 3, 3).copy(),
            "link_linvel": link_vel[:, :3],
            "tip_pos": data.site_xpos[pads].copy(),
            "tip_center": data.site_xpos[centres].copy(),
            "tip_linvel": tip_vel[:, :3],
        }

    return read


def velocity(model, data, kind, index):
    """Linear, then angular velocity in world axes, (6,)."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, index, out, 0)
    return np.roll(out, 3)
