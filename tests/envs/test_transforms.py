"""One assembly for policy, env and replay; ablations drop exactly their columns."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.transforms.assembly import assemble, make_transforms

BLOCKS = [n for n in EnvConfig().transforms if n != "future_window"]


@pytest.fixture(scope="module")
def build(bank, hands):
    """Transforms of the default recipe, with some names changed."""

    def make(offset=1, **changes):
        mapping = {**EnvConfig().transforms, **changes}
        return make_transforms(mapping, bank, hands, reference_offset=offset)

    return make


@pytest.fixture(scope="module")
def steps(make_env):
    """A few steps of five worlds."""
    return make_env(5).rollout(6, break_when_any_done=False)


def test_assembly_leaves_the_state_alone(build, steps):
    state = steps[:, 0]
    before = set(state.keys())
    shown = assemble(build(), state)
    assert set(state.keys()) == before
    new = {keys.OBSERVATION, keys.FUTURE, keys.GROUP_MASK}
    assert set(shown.keys()) == before | new
    assert shown[keys.OBSERVATION].shape == (5, 2308)
    assert shown[keys.FUTURE].shape == (5, 78, 10)


def test_transformed_env_shows_what_the_policy_is_shown(make_env, build):
    transforms = build()
    env = TransformedEnv(make_env(4, seed=2), Compose(*[t.clone() for t in transforms]))
    check_env_specs(env, seed=2)
    td = env.rollout(12, break_when_any_done=False)
    for part in (td, td["next"]):
        for step in range(12):
            shown = assemble(transforms, part[:, step].select(*keys.STATE))
            for key in (keys.OBSERVATION, keys.FUTURE, keys.GROUP_MASK):
                assert torch.equal(part[key][:, step], shown[key])


def test_forward_treats_next_alike(build, steps):
    td = steps[:, 2].select(*keys.STATE, ("next", keys.JOINT_POS))
    td["next"] = steps[:, 2]["next"].select(*keys.STATE)
    expected = assemble(build(), td["next"])[keys.OBSERVATION]
    out = assemble(build(), td)
    assert torch.equal(out["next", keys.OBSERVATION], expected)


@pytest.mark.parametrize("name", BLOCKS)
def test_an_ablation_drops_exactly_its_columns(build, steps, name):
    state = steps[:, 1]
    full = assemble(build(), state)[keys.OBSERVATION]
    less = assemble(build(**{name: None}), state)[keys.OBSERVATION]
    td = state.copy()
    for transform in build()[:-1]:
        td = transform(td)
    widths = {n: td[keys.BLOCKS, n].shape[-1] for n in BLOCKS}
    begin = sum(widths[n] for n in BLOCKS[: BLOCKS.index(name)])
    end = begin + widths[name]
    assert widths[name] > 0
    assert torch.equal(less, torch.cat([full[:, :begin], full[:, end:]], -1))


def test_ablating_the_window_keeps_the_observation(build, steps):
    state = steps[:, 1]
    less = assemble(build(future_window=None), state)
    assert keys.FUTURE not in less.keys()  # noqa: SIM118  a TensorDict
    full = assemble(build(), state)
    assert torch.equal(less[keys.OBSERVATION], full[keys.OBSERVATION])


def test_fewer_points_and_a_longer_window(build, steps):
    options = {"object_points": {"num_points": 16}, "future_window": {"horizon": 14}}
    shown = assemble(build(**options), steps[:, 0])
    assert shown[keys.OBSERVATION].shape[-1] == 2308 - 4 * 3 * (128 - 16)
    assert shown[keys.FUTURE].shape == (5, 78, 14)


def test_hands_without_part_show_zeros(build, steps, bank):
    td = steps[:, 3].copy()
    for transform in build()[:-1]:
        td = transform(td)
    idle = ~bank.hand_active[td[keys.MOTION][:, 0]]
    assert idle.any()
    assert torch.equal(td[keys.GROUP_MASK], ~idle)
    for name in BLOCKS:
        values = td[keys.BLOCKS, name].unflatten(-1, (2, -1))
        assert not values[idle].any()
        assert values[~idle].any()
    window = td[keys.FUTURE].unflatten(1, (2, 39))
    assert not window[idle].any()


def test_bad_numbers_become_zeros_and_bounds(build, make_state):
    state = make_state(3)
    clean = assemble(build(), state)[keys.OBSERVATION]
    state[keys.JOINT_POS][1, 0, 8] = float("nan")
    state[keys.OBJECT_VEL][2] = 1e9
    shown = assemble(build(), state)
    for key in (keys.OBSERVATION, keys.FUTURE):
        assert torch.isfinite(shown[key]).all()
        assert shown[key].abs().max() <= 100
    assert torch.equal(shown[keys.OBSERVATION][0], clean[0])
