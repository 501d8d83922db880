"""Actions to joint targets (method sections 3 and 21)."""

from __future__ import annotations

import pytest
import torch

from flashdex.envs.mdp.actions import joint_target, lowpass, lowpass_alpha

SCALE = torch.tensor([0.1] * 3 + [1.0] * 3)


@pytest.fixture
def joint_range():
    fingers = torch.stack([torch.linspace(-0.5, 0, 12), torch.linspace(1, 2, 12)], -1)
    wrist = torch.tensor([[-5.0, 5.0]] * 3 + [[-6.2, 6.2]] * 3)
    return torch.stack([torch.cat([wrist, fingers])] * 2)


def target(action, ref, joint_range, finger_scale=None):
    return joint_target(
        action[..., :6],
        action[..., 6:],
        ref,
        joint_range,
        wrist_scale=SCALE,
        finger_scale=finger_scale,
    )


def test_alpha_at_sixty_hertz():
    assert lowpass_alpha(5.0, 1 / 60) == pytest.approx(0.3437, abs=5e-5)


def test_no_cut_off_no_filter():
    assert lowpass_alpha(0.0, 1 / 60) == 1.0


def test_filter_is_the_exponential_closed_form():
    alpha, action = 0.3437, torch.ones(1, 2, 6)
    state = lowpass(torch.zeros(1, 2, 6), 0 * action, torch.tensor([True]), alpha=alpha)
    for n in range(1, 6):
        state = lowpass(state, action, torch.tensor([False]), alpha=alpha)
        assert state[0, 0, 0].item() == pytest.approx(1 - (1 - alpha) ** n, rel=1e-5)


def test_first_step_passes_and_only_fresh_worlds_do():
    state = torch.full((2, 2, 6), 0.5)
    action = torch.full((2, 2, 6), -1.0)
    out = lowpass(state, action, torch.tensor([True, False]), alpha=0.25)
    assert (out[0] == -1).all()
    assert (out[1] == 0.5 + 0.25 * -1.5).all()


@pytest.mark.parametrize(("value", "end"), [(-1.0, 0), (1.0, 1)])
def test_absolute_fingers_reach_both_ends(joint_range, value, end):
    ref = torch.rand(3, 2, 18)
    out = target(torch.full((3, 2, 18), value), ref, joint_range)
    expected = joint_range[:, 6:, end].expand(3, 2, 12)
    torch.testing.assert_close(out[..., 6:], expected)
    torch.testing.assert_close(out[..., :6], ref[..., :6] + value * SCALE)


def test_absolute_zero_is_mid_range_whatever_the_reference(joint_range):
    out = target(torch.zeros(1, 2, 18), torch.rand(1, 2, 18), joint_range)
    torch.testing.assert_close(out[0, :, 6:], joint_range[:, 6:].mean(-1))


def test_residual_fingers_start_on_the_reference(joint_range):
    ref = joint_range.mean(-1).expand(2, 2, 18)
    out = target(torch.zeros(2, 2, 18), ref, joint_range, finger_scale=0.3)
    torch.testing.assert_close(out, ref)
    out = target(torch.full((2, 2, 18), 0.5), ref, joint_range, finger_scale=0.3)
    torch.testing.assert_close(out[..., 6:], ref[..., 6:] + 0.15)


def test_targets_stay_within_the_limits(joint_range):
    ref = joint_range[..., 1].expand(4, 2, 18)
    action = torch.rand(4, 2, 18)
    out = target(action, ref, joint_range, finger_scale=0.3)
    torch.testing.assert_close(out, ref)
    out = target(
        -torch.ones(4, 2, 18), joint_range[..., 0].expand(4, 2, 18), joint_range
    )
    torch.testing.assert_close(out, joint_range[..., 0].expand(4, 2, 18))
