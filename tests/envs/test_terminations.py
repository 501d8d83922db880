"""Failure conditions and blame (method sections 9 and 21)."""

from __future__ import annotations

import pytest
import torch

from flashdex.envs.mdp import terminations

LIMITS = {
    "max_link_speed": 100.0,
    "max_joint_speed": 200.0,
    "max_object_speed": 100.0,
    "max_object_spin": 200.0,
}


def first_firing(reward, *, limit=2000):
    """Steps after which a constant object reward ends the episode, None if never."""
    both = torch.ones(1, 2, dtype=torch.bool)
    total = torch.zeros(1, 2)
    for n in range(1, limit + 1):
        total = total + reward
        fires = terminations.early_reset(
            total, torch.tensor([n]), both, threshold=0.6, window=5
        )
        if fires.any():
            assert fires.all()
            return n
    return None


@pytest.mark.parametrize(
    ("reward", "step"), [(0.6, None), (0.59, 61), (0.5, 11), (0.49, 6)]
)
def test_early_reset_fires_first_at(reward, step):
    assert first_firing(reward) == step


def test_early_reset_line_has_no_demand_in_the_first_window():
    line = terminations.early_reset_line(torch.arange(1, 12), threshold=0.6, window=5)
    assert line.tolist() == pytest.approx([0] * 5 + [3] * 5 + [6])


def test_early_reset_blames_the_hands_below_the_line():
    steps, both = torch.tensor([6, 6, 6]), torch.ones(3, 2, dtype=torch.bool)
    total = torch.tensor([[0.0, 3.5], [0.0, 6.5], [1.0, 2.0]])
    fires = terminations.early_reset(total, steps, both, threshold=0.6, window=5)
    # world 1: the mean 3.25 is above the line of 3, so nothing ends
    assert fires.tolist() == [[True, False], [False, False], [True, True]]


def test_early_reset_ignores_a_hand_without_part():
    active = torch.tensor([[False, True]])
    args = {"threshold": 0.6, "window": 5}
    good, bad = torch.tensor([[0.0, 3.2]]), torch.tensor([[9.0, 2.0]])
    steps = torch.tensor([6])
    assert not terminations.early_reset(good, steps, active, **args).any()
    fires = terminations.early_reset(bad, steps, active, **args)
    assert fires.tolist() == [[False, True]]


def test_object_dropped_charges_the_hand_of_that_object():
    ref = torch.full((1, 2, 3), 0.5)
    pos = ref.clone()
    pos[0, 0, 2] -= 0.1001
    pos[0, 1, 2] -= 0.0999
    pos[0, 1, 0] += 3.0  # only the height counts
    fell = terminations.object_dropped(pos, ref, distance=0.1)
    assert fell.tolist() == [[True, False]]


def test_fingertip_off_after_the_grace():
    ref = torch.zeros(3, 2, 5, 3)
    pos = ref.clone()
    pos[:, 1, 3, 0] = 0.201
    pos[:, 0, :, 0] = 0.199
    steps = torch.tensor([14, 15, 16])
    off = terminations.fingertip_off(pos, ref, steps, distance=0.2, grace=15)
    assert off.tolist() == [[False, False], [False, False], [False, True]]


def sane(n=1):
    return {
        "joint_vel": torch.zeros(n, 2, 18),
        "link_linvel": torch.zeros(n, 2, 13, 3),
        "object_vel": torch.zeros(n, 2, 6),
        "numerics": torch.zeros(n, dtype=torch.bool),
    }


def is_insane(state):
    out = terminations.sanity(*state.values(), **LIMITS)
    assert (out[:, 0] == out[:, 1]).all()  # both hands are charged
    return out[:, 0].tolist()


@pytest.mark.parametrize(
    ("key", "index", "limit"),
    [
        ("joint_vel", (1, 1, 7), 200.0),
        ("link_linvel", (1, 0, 5, 2), 100.0),
        ("object_vel", (1, 0, 1), 100.0),
        ("object_vel", (1, 1, 4), 200.0),
    ],
)
def test_sanity_limits_and_bad_numbers(key, index, limit):
    for value, expected in ((0.99 * limit, False), (-1.01 * limit, True)):
        state = sane(3)
        state[key][index] = value
        assert is_insane(state) == [False, expected, False]
    if key != "link_linvel":
        state = sane(3)
        state[key][index] = float("nan")
        assert is_insane(state) == [False, True, False]


def test_sanity_takes_the_engines_word():
    state = sane(2)
    state["numerics"][0] = True
    assert is_insane(state) == [True, False]
