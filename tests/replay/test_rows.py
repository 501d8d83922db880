"""Packed replay rows: what comes out is what the policy saw."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.transforms.assembly import assemble, make_transforms
from flashdex.replay.codec import RowCodec, row_bytes
from flashdex.replay.nstep import NStepAssembler


@pytest.fixture(scope="module")
def transforms(bank, hands):
    return make_transforms(EnvConfig().transforms, bank, hands, reference_offset=1)


@pytest.fixture(scope="module")
def rows(make_env):
    """n-step rows of a rollout with resets, (R,)."""
    env = make_env(6, seed=4)
    td = env.rollout(60, break_when_any_done=False)
    nstep, found = NStepAssembler(5, gamma=0.98), []
    for step in td.unbind(1):
        after = step["next"]
        row = nstep.push(
            step.select(*keys.STATE),
            torch.stack([step[keys.action(s)] for s in keys.SIDES], 1),
            torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1),
            after.select(*keys.STATE),
            after[keys.TERMINATED],
            after[keys.DONE],
        )
        if row is not None:
            found.append(row)
    rows = torch.cat(found)
    assert (rows["steps"] < 5).any()
    return rows


def both_ends(rows):
    return torch.cat([rows["state"], rows["next_state"]])


def test_full_precision_rows_are_exact_up_to_the_last_bit(rows, bank, transforms):
    codec = RowCodec(bank, half=False)
    state, transition = codec.unpack(codec.pack(rows))
    expected = both_ends(rows)
    for key in keys.STATE:
        # positions go through a difference to the reference: one rounding
        torch.testing.assert_close(state[key], expected[key], atol=1e-6, rtol=1e-6)
    for key in (keys.JOINT_VEL, keys.OBJECT_VEL, keys.CONTACT, keys.MOTION, keys.FRAME):
        assert torch.equal(state[key], expected[key])
    assert torch.equal(transition[keys.ACTION], rows["action"].flatten(1))
    assert torch.equal(transition[keys.REWARD], rows["reward"])
    assert torch.equal(transition[keys.TERMINATED], rows["terminated"])
    assert torch.equal(transition[keys.STEPS], rows["steps"])
    ours, theirs = assemble(transforms, state), assemble(transforms, expected)
    for key in (keys.OBSERVATION, keys.FUTURE):
        torch.testing.assert_close(ours[key], theirs[key], atol=1e-4, rtol=1e-4)


def test_half_precision_stays_within_its_tolerance(rows, bank, transforms):
    codec = RowCodec(bank)
    state, _ = codec.unpack(codec.pack(rows))
    expected = both_ends(rows)
    # bounds: 2^-11 relative on the residual to the reference, which is below 1 m here
    for key in (keys.JOINT_POS, keys.JOINT_TARGET):
        assert (state[key] - expected[key])[..., :3].abs().max() < 5e-4
    pose, wanted = state[keys.OBJECT_POSE], expected[keys.OBJECT_POSE]
    assert (pose[..., :3] - wanted[..., :3]).abs().max() < 5e-4
    assert (pose[..., 3:] - wanted[..., 3:]).abs().max() < 6e-4
    vel, wanted = state[keys.JOINT_VEL], expected[keys.JOINT_VEL]
    torch.testing.assert_close(vel, wanted, atol=1e-4, rtol=6e-4)
    ours, theirs = assemble(transforms, state), assemble(transforms, expected)
    error = (ours[keys.OBSERVATION] - theirs[keys.OBSERVATION]).abs()
    assert error.median() < 1e-4
    assert error.quantile(0.999) < 0.02
    error = (ours[keys.FUTURE] - theirs[keys.FUTURE]).abs()
    assert error.quantile(0.999) < 0.02


def test_the_ends_of_the_window_carry_the_right_frames(rows, bank):
    codec = RowCodec(bank)
    state, _ = codec.unpack(codec.pack(rows))
    half = len(rows)
    steps = state[keys.FRAME][half:] - state[keys.FRAME][:half]
    assert torch.equal(steps, rows["steps"])
    assert torch.equal(state[keys.FRAME][half:], rows["next_state", keys.FRAME])
    assert torch.equal(state[keys.MOTION][half:], rows["next_state", keys.MOTION])


def test_a_row_of_two_hands_and_two_objects_fits_in_a_kilobyte(rows, bank):
    packed = RowCodec(bank).pack(rows)
    size = row_bytes(packed)
    leaves = packed.values(True, True)
    assert size == sum(v.numel() * v.element_size() for v in leaves) / len(rows)
    assert size <= 1000


def test_bad_numbers_do_not_survive_packing(rows, bank, transforms):
    row = rows[:4].clone()
    row["next_state", keys.JOINT_POS][0] = float("nan")
    row["next_state", keys.JOINT_VEL][1] = float("inf")
    row["next_state", keys.OBJECT_POSE][2] = 1e12
    codec = RowCodec(bank)
    state, _ = codec.unpack(codec.pack(TensorDict(row, batch_size=[4])))
    shown = assemble(transforms, state)
    assert torch.isfinite(shown[keys.OBSERVATION]).all()
    assert torch.isfinite(shown[keys.FUTURE]).all()
