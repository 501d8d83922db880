"""Farthest points against brute force."""

import numpy as np
import pytest
import torch

from flashdex.geometry.points import farthest_point_sampling


def brute_force(points, k):
    taken = [int(np.argmax(np.linalg.norm(points - points.mean(0), axis=1)))]
    while len(taken) < k:
        gaps = [
            -1.0 if i in taken else min(np.linalg.norm(p - points[j]) for j in taken)
            for i, p in enumerate(points)
        ]
        taken.append(int(np.argmax(gaps)))
    return taken


@pytest.mark.parametrize("k", [1, 2, 17, 60])
def test_matches_brute_force(k):
    points = np.random.default_rng(5).normal(size=(60, 3))
    got = farthest_point_sampling(torch.from_numpy(points), k)
    assert got.tolist() == brute_force(points, k)


def test_duplicates_are_not_taken_twice():
    points = torch.zeros(5, 3)
    assert sorted(farthest_point_sampling(points, 5).tolist()) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("k", [0, 4])
def test_refuses_a_count_it_cannot_meet(k):
    with pytest.raises(ValueError, match="1 to 3"):
        farthest_point_sampling(torch.zeros(3, 3), k)
