"""Targets that lead the servos, against forward dynamics and simulated tracking."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from flashdex.envs.feedforward import reference_targets
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.scene.scene import make_hands_spec
from flashdex.keys import SIDES

FPS, FRAMES = 60.0, 121
PHYSICS = PhysicsConfig(num_threads=1, gravcomp=0.0)
RIGHT = SIDES.index("right")


@pytest.fixture(scope="module")
def waving(hands):
    """A right hand that sweeps a decimetre and turns, twice a second."""
    time = np.arange(FRAMES) / FPS
    pos = np.zeros((FRAMES, 2, hands["right"].num_joints))
    vel = np.zeros_like(pos)
    phase = 2 * np.pi * 2.0
    for joint, size in ((0, 0.1), (2, 0.05), (3, 0.4), (4, 0.3)):
        pos[:, RIGHT, joint] = size * np.sin(phase * time)
        vel[:, RIGHT, joint] = size * phase * np.cos(phase * time)
    pos[:, :, 6:] = hands["right"].joint_range[6:].mean(-1)
    frames = {"joint_pos": pos, "joint_vel": vel}
    return SimpleNamespace(
        fps=FPS,
        frames={k: torch.from_numpy(v).float() for k, v in frames.items()},
        motions={
            "hand_active": torch.tensor([[False, True]]),
            "start": torch.tensor([0]),
            "length": torch.tensor([FRAMES]),
        },
    )


@pytest.fixture(scope="module")
def follow(waving, hands):
    """Wrist errors, (T, 6), of a simulated hand under the targets of a choice."""
    model = make_hands_spec(("right",), hands, PHYSICS).compile()

    def run(feedforward):
        targets = reference_targets(waving, hands, PHYSICS, feedforward)
        data = mujoco.MjData(model)
        data.qpos[:] = waving.frames["joint_pos"][0, RIGHT]
        data.qvel[:] = waving.frames["joint_vel"][0, RIGHT]
        errors = []
        for t in range(1, FRAMES):
            data.ctrl[:] = targets[t, RIGHT]
            mujoco.mj_step(model, data, nstep=PHYSICS.decimation)
            errors.append(
                data.qpos[:6] - waving.frames["joint_pos"][t, RIGHT, :6].numpy()
            )
        return np.abs(np.array(errors)[30:])

    return run


def test_each_choice_follows_a_wave_closer_than_the_one_before(follow):
    none, lag, inverse = (
        follow(name)[:, 0].mean() for name in ("none", "lag", "inverse")
    )
    assert none > 0.02  # m: the servos alone trail by centimetres
    assert lag < 0.7 * none
    assert inverse < 0.3 * lag
    assert inverse < 0.002


def test_inverse_targets_give_the_acceleration_of_the_reference(waving, hands):
    """Forward dynamics under the targets at the two frames of a step, as an oracle."""
    held = PhysicsConfig(num_threads=1, gravcomp=1.0)
    model = make_hands_spec(("right",), hands, held).compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    targets = reference_targets(waving, hands, held, "inverse")[:, RIGHT].numpy()
    pos, vel = (
        waving.frames[k][:, RIGHT].double().numpy() for k in ("joint_pos", "joint_vel")
    )
    acc = np.gradient(vel, axis=0) * FPS
    # each target is the mean of those of two frames, the first one's alone
    own = [targets[0]]
    for row in targets[1:40]:
        own.append(2 * row - own[-1])
    for t in (5, 20, 39):
        data.qpos[:], data.qvel[:], data.ctrl[:] = pos[t], vel[t], own[t]
        mujoco.mj_forward(model, data)
        # fingers have no feed-forward: what they trail by pulls at the wrist a little
        np.testing.assert_allclose(data.qacc[:3], acc[t, :3], rtol=0.05, atol=0.1)


def test_fingers_and_absent_hands_keep_the_reference(waving, hands):
    for name in ("lag", "inverse"):
        targets = reference_targets(waving, hands, PHYSICS, name)
        assert torch.equal(targets[..., 6:], waving.frames["joint_pos"][..., 6:])
        assert torch.equal(targets[:, 0], waving.frames["joint_pos"][:, 0])
    plain = reference_targets(waving, hands, PHYSICS, "none")
    assert torch.equal(plain, waving.frames["joint_pos"])
