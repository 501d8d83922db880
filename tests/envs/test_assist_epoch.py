"""The assist's gates see assisted worlds and hands that take part, nothing else."""

from __future__ import annotations

import pytest
import torch

from flashdex.envs.mdp.assist import AssistEpoch
from flashdex.envs.mdp.step import StepResult

GATES = {"object_points": "task", "wrist_pos": "imitation"}
GATES |= {"behaviour_cloning": "cloning"}


def judged(active, object_points, cloning):
    active = torch.tensor(active)
    terms = {
        "object_points": torch.tensor(object_points) * active,
        "behaviour_cloning": torch.tensor(cloning),
    }
    zeros, rows = torch.zeros(active.shape), torch.zeros(len(active))
    errors = zeros, zeros
    return StepResult(zeros, terms, active & False, {}, *errors, active, rows, rows)


def test_a_perfect_one_handed_world_reaches_one():
    epoch = AssistEpoch(GATES)
    outcome = judged([[False, True]], [[0.0, 1.0]], [[1.0, 0.2]])
    none = torch.zeros(1, 1, dtype=torch.bool)
    epoch.add(outcome, torch.tensor([True]), none, none)
    found = epoch.pop()
    assert found["task"] == pytest.approx(1.0)
    assert found["cloning"] == pytest.approx(0.2)
    assert found["completion"] == 1.0


def test_attempt_worlds_do_not_count():
    epoch = AssistEpoch(GATES)
    outcome = judged(
        [[True, True], [True, True]], [[0.8, 0.6], [0.0, 0.0]], [[0.5] * 2] * 2
    )
    done = torch.tensor([[True], [True]])
    failed = torch.tensor([[False], [True]])
    epoch.add(outcome, torch.tensor([True, False]), done, failed)
    found = epoch.pop()
    assert found["task"] == pytest.approx(0.7)
    assert found["completion"] == 1.0
    assert epoch.pop() == {
        "task": 0.0,
        "imitation": 0.0,
        "cloning": 0.0,
        "completion": 1.0,
    }
