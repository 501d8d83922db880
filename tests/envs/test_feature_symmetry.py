"""Moving the whole scene changes nothing in wrist frames; windows at the reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from flashdex import keys
from flashdex.envs.reference import gather_own
from flashdex.envs.transforms.contact import contact
from flashdex.envs.transforms.future_window import future_window
from flashdex.envs.transforms.object_points import object_points
from flashdex.envs.transforms.object_state import object_state
from flashdex.envs.transforms.proprioception import proprioception
from flashdex.envs.transforms.reference_delta import reference_delta
from flashdex.envs.transforms.surface_distance import fingertip_distance
from flashdex.geometry.rotation import quat_mul, quat_rotate, quat_to_matrix
from flashdex.hands.kinematics import HandKinematics

TURN = torch.tensor(
    np.roll(Rotation.from_rotvec([0.7, -1.1, 2.0]).as_quat(), 1)
).float()
SHIFT = torch.tensor([0.4, -1.3, 0.8])


def move(name, values):
    """Turn and shift one named quantity of the scene."""
    if name.endswith("quat"):
        return quat_mul(TURN, values)
    turned = quat_rotate(TURN, values)
    return turned + SHIFT if name.endswith(("pos", "center")) else turned


LENGTHS = ("tip_dist", "joint_pos", "joint_vel", "joint_target")  # and angles


def moved(td):
    kept = {n: v for n, v in td.items() if n not in LENGTHS}
    return TensorDict({n: move(n, v) for n, v in kept.items()}, td.batch_size)


def moved_window(vectors, rotations):
    """Positions shift as well, velocities (1 and 2) do not; matrices are transposed."""
    out = quat_rotate(TURN, vectors)
    positions = [i for i in range(9) if i not in (1, 2)]
    out[..., positions, :] += SHIFT
    return out, rotations @ quat_to_matrix(TURN).mT


@pytest.fixture
def scene(make_state, bank, hands):
    """State, kinematics, reference, window, and the own objects' pose and velocity."""
    state = make_state(8, seed=3)
    motion, frame = state[keys.MOTION][:, 0], state[keys.FRAME][:, 0]
    slot = bank.hand_slot[motion]
    pose = gather_own(state[keys.OBJECT_POSE], slot)
    vel = gather_own(state[keys.OBJECT_VEL], slot)
    kin = HandKinematics(hands)(state[keys.JOINT_POS], state[keys.JOINT_VEL])
    ref, window = bank.at(motion, frame), bank.window(motion, frame, 10)
    own = {
        "pos": pose[..., :3],
        "quat": pose[..., 3:],
        "lin": vel[..., :3],
        "ang": vel[..., 3:],
    }
    return state, kin, ref, window, own, bank.hand_object[motion]


def test_wrist_frame_features_ignore_where_the_scene_is(scene, bank, hands):
    state, kin, ref, window, own, rows = scene
    radius = torch.stack(
        [torch.as_tensor(hands[s].tip_radius) for s in keys.SIDES]
    ).float()
    links = torch.arange(12).expand(2, 12)

    def observe(kin, ref, window, own):
        vel = torch.cat([own["lin"], own["ang"]], -1)
        pos, quat = own["pos"], own["quat"]
        distance = fingertip_distance(kin, pos, quat, rows, bank.sdf, radius)
        joints = [state[k] for k in (keys.JOINT_POS, keys.JOINT_VEL, keys.JOINT_TARGET)]
        return {
            # palm pose and velocity and the link deltas are in the world by design
            "proprioception": proprioception(kin, *joints)[..., 13:],
            "delta": reference_delta(kin, ref, pos, quat, links)[..., -7:],
            "object": object_state(kin, pos, quat, vel),
            "points": object_points(kin, ref, pos, quat, bank.points[rows]),
            "distance": distance[0],
            "normal": distance[1],
            "contact": contact(kin, state[keys.CONTACT]),
            "window": future_window(kin, *window, pos, quat, vel),
        }

    before = observe(kin, ref, window, own)
    after = observe(
        moved(kin),
        moved(ref),
        moved_window(*window),
        {n: move(n, v) for n, v in own.items()},
    )
    for name, values in before.items():
        torch.testing.assert_close(after[name], values, atol=2e-4, rtol=1e-3, msg=name)


def at_reference(bank, motion, frame):
    """Kinematics that coincide with the human hand, and the objects' reference."""
    ref = bank.at(motion, frame)
    kin = {n: ref[n] for n in ("wrist_pos", "wrist_quat", "tip_pos")}
    vel = torch.cat([ref["own_linvel"], ref["own_angvel"]], -1)
    return TensorDict(kin, ref.batch_size), ref["own_pos"], ref["own_quat"], vel


def test_window_is_neutral_on_the_reference(bank):
    motion, frame = torch.full((20,), 2), torch.arange(10, 30)
    state = at_reference(bank, motion, frame)
    kin, *own = state
    window = future_window(kin, *bank.window(motion, frame, 10), *own)
    now = window[..., 0]
    neutral = torch.zeros(39)
    neutral[3:9] = neutral[18:24] = torch.tensor([1.0, 0, 0, 0, 1.0, 0])
    torch.testing.assert_close(now, neutral.expand_as(now), atol=1e-5, rtol=0)
    assert (window[..., 9] - now).abs().max() > 1e-3


def test_window_repeats_the_last_frame(bank):
    last = bank.length[:2] - 1
    motion = torch.arange(2)
    kin, *own = at_reference(bank, motion, last - 2)
    window = future_window(kin, *bank.window(motion, last - 2, 6), *own)
    for step in (3, 4, 5):
        assert torch.equal(window[..., step], window[..., 2])
    assert not torch.equal(window[..., 1], window[..., 2])


def test_frames_clamp_at_both_ends(bank, library):
    motion = torch.tensor([1, 1, 0])
    got = bank.at(motion, torch.tensor([-3, 400, 400]))["joint_pos"]
    start, length = library.motions["start"], library.motions["length"]
    rows = [start[1], start[1] + length[1] - 1, start[0] + length[0] - 1]
    expected = library.frames["joint_pos"][torch.stack(rows)]
    assert torch.equal(got, expected)
