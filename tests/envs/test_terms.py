"""A reward, a termination and an observation of one's own: one file, read by all."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum
from torchrl.envs.utils import check_env_specs

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp import allow, number, reward
from flashdex.envs.mdp.assist import AssistEpoch
from flashdex.envs.mdp.term import default_mapping, find_term
from flashdex.envs.transforms.assembly import ConcatBlocks, assemble, make_transforms
from flashdex.envs.transforms.base import Block, BlockContext
from flashdex.errors import FlashdexError, RecipeError, UnknownNameError
from flashdex.recipe import compose

DOCS = Path(__file__).parents[2] / "docs"
OWN = {
    "rewards": {"slow": {"_target_": "my_terms.slow_object", "scale": 0.05}},
    "terminations": {"lost": {"_target_": "my_terms.object_lost", "distance": 0.01}},
    "transforms": {"height": {"_target_": "my_terms.object_height"}},
}


pytestmark = pytest.mark.usefixtures("forget_terms")


@pytest.fixture
def my_terms(tmp_path, monkeypatch):
    """The example of docs/extend.md as an importable file, neither allowed nor read."""
    page = (DOCS / "extend.md").read_text()
    code = re.search(r"```python\n(# my_terms\.py\n.*?)```", page, re.DOTALL)[1]
    (tmp_path / "my_terms.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_terms", raising=False)
    yield "my_terms"
    sys.modules.pop("my_terms", None)


@pytest.fixture
def own_env(my_terms, make_env):
    """An env with the default terms and the example's."""
    allow(my_terms)
    config = EnvConfig()

    def make(num_envs=6, **fields):
        mappings = {k: {**getattr(config, k), **v} for k, v in OWN.items()}
        return make_env(num_envs, attempt_share=0.5, **{**mappings, **fields})

    return make


def test_a_registered_term_is_checked_and_stands_on_the_page(my_terms):
    importlib.import_module(my_terms)
    names = [f"+env.rewards.slow_object.{k}" for k in ("scale=2", "weight=1")]
    recipe = compose("quickstart", [*names, "+env.terminations.object_lost={}"])
    assert recipe.env.rewards["slow_object"] == {"weight": 1.0, "scale": 2.0}
    assert recipe.env.terminations["object_lost"] == {"distance": 0.5}
    assert "slow_object" not in compose("quickstart").env.rewards
    wrong = ["+env.rewards.slow_object.scale=0", "+env.transforms.object_height.x=1"]
    with pytest.raises(RecipeError) as error:
        compose("quickstart", wrong)
    found = "\n".join(error.value.problems)
    assert "env.rewards.slow_object.scale: 0 must be greater than 0" in found
    assert "env.transforms.object_height.x: unknown argument" in found
    spec = importlib.util.spec_from_file_location("page", DOCS / "make_options.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    page = script.render()
    assert "### env.rewards.slow_object\n\nObjects that hardly turn" in page
    row = "| `scale` | `1.0` | number &gt; 0 and &le; 1000 | Steepness, s/rad. |"
    assert row in page
    assert "### env.terminations.object_lost" in page
    assert "### env.transforms.object_height\n\nHeight of each hand's object" in page


def test_it_is_masked_gated_and_named(own_env, bank):
    env = own_env()
    td = env.rollout(8, break_when_any_done=False)
    values = torch.stack(
        [td["next", keys.reward_term(s, "slow")] for s in keys.SIDES], 2
    )
    has_object = bank.has_object[td[keys.MOTION][..., 0]]
    assert (~has_object).any()
    assert not values[..., 0][~has_object].any()
    assert (values[..., 0][has_object] > 0).all()
    assert env.terms.gates["slow"] == "imitation"
    assert "slow" in env.last_step.reward_terms
    assert "lost" in env.last_step.terminations
    assert env.terms.weights["slow"] == 0.1
    lost = env.last_step.terminations["lost"]
    assert not lost[~env.last_step.active].any()
    epoch, none = AssistEpoch(env.terms.gates), torch.zeros(6, 1, dtype=torch.bool)
    epoch.add(env.last_step, ~env.attempt, none, none)
    counts = env.last_step.active & ~env.attempt[:, None]
    names = ("wrist_pos", "wrist_rot", "fingertip_pos", "slow")
    terms = [env.last_step.reward_terms[n][counts].double().mean() for n in names]
    assert epoch.pop()["imitation"] == pytest.approx(sum(terms).item() / 4)


def test_a_class_of_terms_keeps_and_forgets(make_env):
    @reward("count", weight=0.0)
    class Count:
        """Steps since the reset.

        Args:
            context: number of worlds.
            stride: What a step adds.
        """

        def __init__(self, context, *, stride: float = number(2.0, above=0, high=100)):
            self.total = torch.zeros(context.num_envs, 2)
            self.stride = stride

        def reset(self, mask):
            self.total = torch.where(mask[:, None], 0.0, self.total)

        def __call__(self, step):
            self.total = self.total + self.stride
            return self.total

    env = make_env(3, terminations={}, rewards={"count": {}, "action_l2": {}})
    td = env.reset()
    for _ in range(4):
        td = env.step(env.rand_action(td))["next"]
    env.reset_worlds(torch.tensor([True, False, False]))
    env.step(env.rand_action(td))
    expected = 2 * env.steps[:, None].expand(-1, 2).float()
    assert torch.equal(env.last_step.reward_terms["count"], expected)
    assert Count(env.terms.context).stride == 2.0  # plain defaults in Python


def test_terms_are_functions_that_can_be_called(my_terms):
    module = importlib.import_module(my_terms)
    step = type("Step", (), {"own_vel": torch.ones(1, 2, 6)})()
    expected = torch.exp(-torch.tensor(3.0).sqrt()).expand(1, 2)
    torch.testing.assert_close(module.slow_object(step), expected)


def test_a_package_that_is_not_allowed_is_not_imported(my_terms):
    with pytest.raises(RecipeError) as error:
        compose("quickstart", ["+env.rewards.mine._target_=my_terms.slow_object"])
    (problem,) = error.value.problems
    assert problem.startswith(
        "env.rewards.mine: unknown reward. 'my_terms.slow_object'"
    )
    for word in ("--allow my_terms", "allow('my_terms')", "need it again"):
        assert word in problem
    assert my_terms not in sys.modules
    with pytest.raises(FlashdexError, match="not allowed"):
        find_term("rewards", "mine", {"_target_": "my_terms_too.x"})
    allow("my_terms.deeper")
    with pytest.raises(FlashdexError, match="not allowed"):
        find_term("rewards", "mine", {"_target_": "my_terms.slow_object"})


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("my_terms.slow_objet", "cannot be imported: AttributeError"),
        ("my_terms.none.slow_object", "cannot be imported: ModuleNotFoundError"),
        ("my_terms.object_lost", "is no reward; write @reward() above it"),
        ("my_terms", "not allowed"),
        ("torchrl.envs.TransformedEnv", "is no reward"),
    ],
)
def test_a_target_that_is_no_term_is_refused(my_terms, target, expected):
    allow(my_terms)
    with pytest.raises(RecipeError, match=re.escape(expected)):
        compose("quickstart", [f"+env.rewards.mine._target_={target}"])


def test_a_shipped_term_needs_no_permission_to_be_there_twice():
    target = "flashdex.envs.mdp.rewards.wrist_pos_error_exp"
    options = [f"+env.rewards.near={{_target_: {target}, scale: 40}}"]
    recipe = compose("quickstart", options)
    assert recipe.env.rewards["near"]["scale"] == 40.0
    assert recipe.env.rewards["near"]["_target_"] == target


def test_a_name_that_is_taken_is_refused():
    with pytest.raises(FlashdexError, match="there is a reward 'wrist_pos' already"):

        @reward()
        def wrist_pos(step):
            """Another."""


def test_what_is_not_shipped_is_no_default():
    assert list(default_mapping("transforms"))[-1] == "future_window"
    assert default_mapping("rewards")["object_pose"] is None
    with pytest.raises(UnknownNameError, match=r"env\.rewards"):
        find_term("rewards", "wrist_po", {})


# -- observations and the env as TorchRL sees them ------------------------------


@pytest.fixture
def transformed(make_env, bank, hands):
    """A TransformedEnv, with changes of ``env.transforms``."""

    def make(num_envs=4, **changes):
        mapping = {**EnvConfig().transforms, **changes}
        transforms = make_transforms(mapping, bank, hands, reference_offset=1)
        return TransformedEnv(make_env(num_envs, seed=2), Compose(*transforms))

    return make


def place(env, name):
    """Index of a named block among the transforms of an env."""
    blocks = [getattr(transform, "name", None) for transform in env.transform]
    return blocks.index(name)


def test_the_env_has_the_specs_that_torchrl_reads(transformed, make_env):
    env = transformed()
    check_env_specs(make_env(3))
    check_env_specs(env)
    assert set(env.group_map) == set(keys.SIDES)
    assert set(env.reward_keys) == {keys.reward(s) for s in keys.SIDES}
    assert set(env.action_keys) == {keys.action(s) for s in keys.SIDES}
    names = env.base_env.terms.reward_names
    for side in keys.SIDES:
        assert set(env.observation_spec[side, keys.REWARD_TERMS].keys()) == set(names)
        assert env.observation_spec[keys.failed(side)].dtype == torch.bool
    sums = [(side, "return") for side in keys.SIDES]
    env.append_transform(RewardSum(env.reward_keys, sums))
    td = env.rollout(5, break_when_any_done=False)
    assert td["next", "left", "return"].shape == (4, 5, 1)


def test_terms_and_failures_stand_beside_the_reward(make_env):
    env = make_env(6, attempt_share=0.0, seed=4)
    td = env.rollout(40, break_when_any_done=False)
    after, weights = td["next"], env.terms.weights
    failed = torch.cat([after[keys.failed(s)] for s in keys.SIDES], -1)
    assert failed.any()
    assert torch.equal(failed.any(-1, keepdim=True), after[keys.TERMINATED])
    active = env.bank.hand_active[td[keys.MOTION][..., 0]]
    for i, side in enumerate(keys.SIDES):
        terms = after[side, keys.REWARD_TERMS]
        assert torch.equal(terms["failure"], failed[..., i : i + 1].float())
        share = {n: 1.0 if n == "failure" else 0.5 for n in weights}
        total = sum(share[n] * weights[n] * terms[n] for n in weights) / 60
        total = total * active[..., i : i + 1]
        torch.testing.assert_close(after[keys.reward(side)], total)
    # a world that starts anew has no terms yet; the others keep those of their step
    done = after[keys.DONE][:, :-1, 0]
    for side in keys.SIDES:
        now, last = td[side, keys.REWARD_TERMS, "wrist_pos"], after[side]
        last = last[keys.REWARD_TERMS, "wrist_pos"]
        assert not now[:, 1:][done].any()
        assert torch.equal(now[:, 1:][~done], last[:, :-1][~done])


@pytest.mark.parametrize("name", ["object_points", "proprioception"])
def test_a_block_can_be_taken_out_in_python(transformed, name):
    env, less = transformed(), transformed(**{name: None})
    full = env.rollout(3, break_when_any_done=False)
    assert full[keys.OBSERVATION].shape[-1] == 2308
    env.transform.pop(place(env, name))
    env.empty_cache()
    check_env_specs(env)
    expected = less.observation_spec[keys.OBSERVATION]
    assert env.observation_spec[keys.OBSERVATION] == expected
    td = env.rollout(4, break_when_any_done=False)
    shown = assemble(list(less.transform), td[:, 2].select(*keys.STATE))
    assert torch.equal(td[:, 2][keys.OBSERVATION], shown[keys.OBSERVATION])


def test_a_block_of_ones_own_can_be_put_in(transformed, bank, hands):
    class Height(Block):
        """Height of the own object."""

        needs_object = True

        def features(self, td):
            return td[keys.OWN, "pos"][..., 2:]

    env = transformed()
    block = Height(BlockContext("height", bank, hands, 1))
    assert isinstance(env.transform[-1], ConcatBlocks)
    env.insert_transform(len(env.transform) - 1, block)
    env.empty_cache()
    check_env_specs(env)
    td = env.rollout(3, break_when_any_done=False)
    shown = td[keys.OBSERVATION][..., -2:]
    slot = bank.hand_slot[td[keys.MOTION][..., 0]]
    height = td[keys.OBJECT_POSE][..., 2].gather(-1, slot)
    expected = height * bank.has_object[td[keys.MOTION][..., 0]]
    assert torch.equal(shown, expected)


def test_an_observation_by_target_joins_the_others(my_terms, bank, hands, make_state):
    allow(my_terms)
    own = {"object_state": {}, **OWN["transforms"]}
    transforms = make_transforms(own, bank, hands, reference_offset=0)
    td = TensorDict(make_state(5).to_dict(), [5])
    for transform in transforms[:-1]:
        td = transform(td)
    assert list(td[keys.BLOCKS].keys()) == ["object_state", "height"]
    assert transforms[-1](td)[keys.OBSERVATION].shape == (5, 28)
