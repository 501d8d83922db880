"""Observations as one function of tensors: the same numbers, without graph breaks."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.transforms.assembly import (
    OUTPUTS,
    Assembly,
    assemble,
    make_transforms,
)


@pytest.fixture(scope="module")
def make(bank, hands):
    """Transforms of the default recipe, with changes."""

    def build(**changes):
        mapping = {**EnvConfig().transforms, **changes}
        kept = {
            name: options for name, options in mapping.items() if options is not None
        }
        return make_transforms(kept, bank, hands, reference_offset=0)

    return build


@pytest.fixture(scope="module")
def states(make_env, bank):
    """States of a real env, their replicas moved at random, (64,)."""
    td = make_env(4).rollout(16, break_when_any_done=False).reshape(-1)
    state = td.select(*keys.STATE)
    generator = torch.Generator().manual_seed(2)
    for key, size in ((keys.JOINT_POS, 0.1), (keys.OBJECT_POSE, 0.05)):
        value = state[key]
        state[key] = value + size * torch.randn(value.shape, generator=generator)
    pose = state[keys.OBJECT_POSE]
    state[keys.OBJECT_POSE] = torch.cat([pose[..., :3], normalize(pose[..., 3:])], -1)
    return state


def compare(transforms, state, ours, **tolerance):
    expected = assemble(transforms, state)
    assert set(ours.keys()) == {k for k in OUTPUTS if k in expected.keys()}  # noqa: SIM118
    for key in ours.keys():  # noqa: SIM118
        assert ours[key].shape == expected[key].shape
        torch.testing.assert_close(ours[key], expected[key], **tolerance)


@pytest.mark.parametrize("future", [True, False])
def test_it_equals_the_transforms_one_after_the_other(make, states, future):
    transforms = make() if future else make(future_window=None)
    before = states.clone()
    ours = Assembly(transforms)(states)
    compare(transforms, states, ours, atol=0, rtol=0)
    assert (states == before).all()
    assert set(states.keys()) == set(before.keys())


def test_a_diverged_world_stays_one(make, states):
    state = states.clone()
    state[keys.JOINT_POS][3] = float("nan")
    state[keys.OBJECT_VEL][5] = float("inf")
    ours = Assembly(make())(state)
    compare(make(), state, ours, atol=0, rtol=0)
    assert all(value.isfinite().all() for value in ours.values())


def test_it_is_one_graph(make, states):
    """``fullgraph`` raises at anything the compiler cannot follow."""
    torch.compiler.reset()
    compiled = Assembly(make(), compile=True, backend="eager")
    compare(make(), states, compiled(states), atol=0, rtol=0)


def test_what_is_no_state_transform_is_refused():
    with pytest.raises(TypeError, match="Module is no StateTransform"):
        Assembly([torch.nn.Module()])


@pytest.mark.slow
def test_compiled_observations_are_those_of_the_transforms(make, states):
    torch.compiler.reset()
    compiled = Assembly(make(), compile=True)
    compare(make(), states, compiled(states), atol=1e-5, rtol=1e-5)
