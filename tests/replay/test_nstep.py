"""n-step windows by brute force over random episodes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from flashdex.replay.nstep import NStepAssembler

GAMMA, WORLDS, LENGTH = 0.9, 7, 60


@pytest.fixture
def episodes():
    """Random steps of WORLDS worlds; states are numbered, ends are frequent."""
    g = torch.Generator().manual_seed(0)
    number = torch.arange(LENGTH * WORLDS).reshape(LENGTH, WORLDS, 1).float()
    terminated = torch.rand(LENGTH, WORLDS, 1, generator=g) < 0.15
    truncated = torch.rand(LENGTH, WORLDS, 1, generator=g) < 0.15
    return {
        "state": number,
        "next": number + 0.5,  # the state before any reset, unlike the next root
        "action": torch.randn(LENGTH, WORLDS, 2, 3, generator=g),
        "reward": torch.randn(LENGTH, WORLDS, 2, generator=g),
        "terminated": terminated & ~truncated,
        "done": terminated | truncated,
    }


def push(nstep, e, t):
    def td(values):
        return TensorDict({"x": values}, batch_size=[WORLDS])

    names = ("action", "reward")
    action, reward = (e[n][t] for n in names)
    return nstep.push(
        td(e["state"][t]),
        action,
        reward,
        td(e["next"][t]),
        e["terminated"][t],
        e["done"][t],
    )


def brute_force(e, start, world, n):
    total, end = torch.zeros(2), start
    for j in range(n):
        end = start + j
        total = total + GAMMA**j * e["reward"][end, world]
        if e["done"][end, world]:
            break
    return total, end


@pytest.mark.parametrize("n", [1, 3, 5])
def test_rows_equal_brute_force(episodes, n):
    nstep = NStepAssembler(n, gamma=GAMMA)
    rows = [push(nstep, episodes, t) for t in range(LENGTH)]
    assert all(row is None for row in rows[: n - 1])
    assert all(row is not None for row in rows[n - 1 :])
    shortened = moved_flags = 0
    for start, row in enumerate(rows[n - 1 :]):
        assert torch.equal(row["state", "x"], episodes["state"][start])
        assert torch.equal(row["action"], episodes["action"][start])
        for world in range(WORLDS):
            total, end = brute_force(episodes, start, world, n)
            torch.testing.assert_close(row["reward"][world], total)
            assert row["steps"][world] == end - start + 1
            assert row["next_state", "x"][world] == episodes["next"][end, world]
            flag = episodes["terminated"][end, world]
            assert row["terminated"][world] == flag
            shortened += int(end - start + 1 < n)
            moved_flags += int(flag != episodes["terminated"][start, world])
    assert n == 1 or (shortened > 50 and moved_flags > 50)


@pytest.mark.parametrize("split", [0, 2, 17])
def test_the_tail_resumes(episodes, split):
    one, two = (NStepAssembler(5, gamma=GAMMA) for _ in range(2))
    for t in range(split):
        push(one, episodes, t)
    two.load_state_dict(one.state_dict())
    for t in range(split, LENGTH):
        a, b = push(one, episodes, t), push(two, episodes, t)
        assert (a is None) == (b is None)
        if a is not None:
            flat, again = (td.flatten_keys().to_dict() for td in (a, b))
            assert all(torch.equal(flat[k], again[k]) for k in flat)


def test_clear_starts_a_new_window(episodes):
    nstep = NStepAssembler(3, gamma=GAMMA)
    for t in range(10):
        push(nstep, episodes, t)
    nstep.clear()
    assert push(nstep, episodes, 10) is None
    assert push(nstep, episodes, 11) is None
    row = push(nstep, episodes, 12)
    assert torch.equal(row["state", "x"], episodes["state"][10])


def test_pushed_steps_are_not_changed(episodes):
    nstep = NStepAssembler(3, gamma=GAMMA)
    before = {k: v.clone() for k, v in episodes.items()}
    for t in range(20):
        push(nstep, episodes, t)
    assert all(torch.equal(before[k], episodes[k]) for k in before)
