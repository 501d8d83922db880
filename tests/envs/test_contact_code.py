"""Seven bytes a contact: bounds of the round trip."""

from __future__ import annotations

import math

import pytest
import torch

from flashdex.envs.transforms.contact import (
    MAX_FORCE,
    POINT_RANGE,
    decode_contact,
    encode_contact,
)


@pytest.fixture
def contacts():
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(
        torch.randn(4000, 3, generator=generator), dim=-1
    )
    size = torch.expm1(torch.rand(4000, 1, generator=generator) * math.log1p(MAX_FORCE))
    size = size.clamp_min(0.1)
    point = (2 * torch.rand(4000, 3, generator=generator) - 1) * POINT_RANGE
    return direction, size, point


def test_round_trip_stays_within_half_a_step(contacts):
    direction, size, point = contacts
    got, log_force, got_point = decode_contact(encode_contact(direction * size, point))
    step = 0.5 / 127
    # a cube of half-width `step` around the direction, projected back to the sphere
    angle = torch.acos((got * direction).sum(-1).clamp(-1, 1))
    assert angle.max() < math.asin(math.sqrt(3) * step) + 1e-3
    error = (log_force - torch.log1p(size)).abs().max()
    assert error <= step * math.log1p(MAX_FORCE) * 1.001
    assert (got_point - point).abs().max() <= step * POINT_RANGE * 1.001
    torch.testing.assert_close(got.norm(dim=-1), torch.ones(4000))


def test_no_contact_is_all_zero():
    code = encode_contact(torch.zeros(2, 13, 3), torch.full((2, 13, 3), 0.05))
    assert code.dtype == torch.int8
    assert not code.any()
    assert not any(part.any() for part in decode_contact(code))


def test_large_forces_saturate():
    for force in (500.0, 1e6):
        code = encode_contact(torch.tensor([force, 0.0, 0.0]), torch.zeros(3))
        direction, log_force, _ = decode_contact(code)
        assert direction.tolist() == [1, 0, 0]
        assert log_force.item() == pytest.approx(math.log1p(MAX_FORCE))
