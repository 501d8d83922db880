"""Continuous metrics against closed forms."""

import math

import pytest
import torch

from flashdex.geometry.rotation import quat_from_axis_angle
from flashdex.metrics.continuous import (
    add_auc,
    add_auc_dexmachina,
    add_distance,
    lift_ratio,
    mppe,
    object_path_length,
    off_by,
    path_ratio,
    sample_vertices,
    smoothness,
)

T = 20
IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)


def shifted(distance):
    pos = torch.zeros(T, 1, 3, dtype=torch.float64)
    pos[..., 1] = distance
    return pos


@pytest.mark.parametrize(
    ("shift", "area"), [(0.035, 0.6875), (0.005, 1.0), (0.085, 0.0625), (0.095, 0.0)]
)
def test_add_of_a_pure_shift_is_the_shift(shift, area):
    vertices = torch.randn(100, 3, dtype=torch.float64)
    quat = IDENTITY.expand(T, 4)
    add = add_distance(vertices, shifted(shift)[:, 0], quat, shifted(0)[:, 0], quat)
    torch.testing.assert_close(add, torch.full((T,), shift, dtype=torch.float64))
    assert add_auc(add) == pytest.approx(area)


def test_add_of_a_turn_is_the_mean_chord():
    ring = torch.linspace(0, 2 * math.pi, 65, dtype=torch.float64)[:-1]
    vertices = 0.05 * torch.stack((ring.cos(), ring.sin(), torch.zeros(64)), -1)
    axis = torch.tensor([0, 0, 1], dtype=torch.float64)
    quat = quat_from_axis_angle(axis, torch.tensor(0.7, dtype=torch.float64))
    zero = torch.zeros(3, dtype=torch.float64)
    add = add_distance(vertices, zero, quat, zero, IDENTITY)
    assert add.item() == pytest.approx(2 * 0.05 * math.sin(0.35))


def test_dexmachina_area_is_the_mean_over_parts():
    parts = [torch.full((5,), 0.035), torch.full((9,), 0.085)]
    assert add_auc_dexmachina(parts) == pytest.approx((0.6875 + 0.0625) / 2)


def test_mppe_of_a_turn_and_of_a_shift():
    axis = torch.tensor([0, 0, 1], dtype=torch.float64)
    turn = quat_from_axis_angle(axis, torch.tensor(math.pi / 6, dtype=torch.float64))
    still = IDENTITY.expand(T, 1, 4)
    turned = mppe(shifted(0), turn.expand(T, 1, 4), shifted(0), still)
    assert turned.item() == pytest.approx((4 / 6) * 0.1 * math.sin(math.pi / 12))
    assert 100 * turned.item() == pytest.approx(1.7255, abs=5e-5)
    assert mppe(shifted(0.04), still, shifted(0), still).item() == pytest.approx(0.04)


def test_mppe_takes_the_worst_body_of_a_frame():
    pos = torch.cat((shifted(0.01), shifted(0.03)), 1)
    still = IDENTITY.expand(T, 2, 4)
    assert mppe(pos, still, torch.zeros_like(pos), still).item() == pytest.approx(0.03)


def test_vertices_are_drawn_the_same_way_every_time():
    mesh = torch.randn(2000, 3)
    first, again = sample_vertices(mesh), sample_vertices(mesh)
    assert torch.equal(first, again)
    assert len(torch.unique(first, dim=0)) == 500
    assert not torch.equal(first, sample_vertices(mesh, seed=0))
    assert sample_vertices(mesh[:8]).shape == (500, 3)


def test_path_length_lift_and_smoothness():
    angle = torch.linspace(0, math.pi, 2001, dtype=torch.float64)
    arc = torch.stack((angle.cos(), torch.zeros(2001), angle.sin()), -1) * 0.1
    assert object_path_length(arc).item() == pytest.approx(0.1 * math.pi, rel=1e-6)
    assert lift_ratio(arc * 0.5, arc) == pytest.approx(0.5)
    assert lift_ratio(arc, arc * 0.19) is None
    velocity = torch.arange(10.0)[:, None] * 0.02
    assert smoothness(velocity, fps=50) == pytest.approx(1.0, rel=1e-5)


def rise(height, *, steps=31, path=0.0):
    """A track that rises, and swings sideways over ``path`` metres."""
    track = torch.zeros(steps, 3, dtype=torch.float64)
    track[:, 2] = torch.linspace(0, height, steps)
    track[:, 0] = torch.linspace(0, path, steps)
    return track


@pytest.mark.parametrize(
    ("ratio", "off"),
    [(1.0, 0.0), (1.25, 0.25), (0.8, 0.25), (0.0, 999.0), (-3.0, 999.0), (None, 0.0)],
)
def test_a_ratio_is_as_far_off_above_as_below(ratio, off):
    assert off_by(ratio) == pytest.approx(off)


@pytest.mark.parametrize("steps", [31, 61, 1001])
def test_path_ratio_is_that_of_lengths_whatever_the_rate(steps):
    found = path_ratio(rise(0.05, steps=steps), rise(0.1, steps=steps))
    assert found == pytest.approx(0.5, abs=0.01)


def test_noise_at_rest_is_no_path():
    noise = 0.001 * torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
    # frame by frame it walks more than a metre
    assert object_path_length(noise) > 1.0
    assert path_ratio(torch.zeros(600, 3), noise) is None
    moved = torch.zeros(600, 3)
    moved[300:, 0] = torch.linspace(0, 0.3, 300)
    assert path_ratio(moved, moved + noise) == pytest.approx(1, abs=0.1)


def test_a_reference_that_hardly_moves_asks_for_no_path():
    assert path_ratio(rise(1.0), rise(0.01)) is None


def test_there_and_back_is_a_path_and_no_lift():
    there = rise(0.1, steps=31)
    track = torch.cat([there, there.flip(0)])
    assert path_ratio(track, there) == pytest.approx(2.0, abs=0.1)
    assert lift_ratio(track, there.repeat_interleave(2, 0)) == pytest.approx(1.0)
