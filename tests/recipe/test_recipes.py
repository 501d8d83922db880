"""Recipes: composing, checking, ablations, and no default stated twice."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import yaml

from flashdex.envs.config import GymConfig
from flashdex.envs.mdp.term import KINDS, registry
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.errors import FlashdexError, RecipeError, UnknownRecipeError
from flashdex.hands.gains import GainsPreset
from flashdex.metrics.criteria_table import CRITERIA, criterion_names
from flashdex.recipe import (
    GymRecipe,
    MotionsConfig,
    Recipe,
    compose,
    compose_runs,
    dump_recipe,
    load_recipe,
    override_recipe,
    validate,
)

RECIPES = Path(__file__).parents[2] / "recipes"
NAMES = sorted(path.stem for path in RECIPES.glob("*.yaml"))
GROUPS = sorted(RECIPES.glob("*/*.yaml"))
ABLATIONS = sorted(path.stem for path in (RECIPES / "ablation").glob("*.yaml"))

FIVE_MISTAKES = """
defaults:
  - motions: procedural
  - _self_
  - ablation: no_futur
total_env_steps: many
env:
  num_env: 8
  transforms:
    object_pointz: {}
    future_window: {horizons: 5}
"""


def problems_of(name, overrides=()):
    with pytest.raises(RecipeError) as caught:
        compose(name, overrides)
    return caught.value.problems


@pytest.fixture
def write_recipe(tmp_path):
    def write(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("name", NAMES)
def test_every_recipe_composes(name):
    recipe = compose(name)
    assert recipe.name == name
    assert recipe.ablation == "none"


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_every_ablation_composes_and_acts(ablation):
    base, changed = (
        compose("bench50_xhand"),
        compose("bench50_xhand", [f"ablation={ablation}"]),
    )
    same = dataclasses.replace(changed, ablation="none") == base
    assert same == (ablation == "none")
    assert changed.ablation == ablation


def test_five_mistakes_are_reported_at_once(write_recipe):
    found = problems_of(write_recipe(FIVE_MISTAKES))
    assert len(found) == 5
    for pattern in (
        r"^ablation=no_futur: .*Did you mean 'no_future'\?",
        r"^total_env_steps: expected an integer, found 'many'",
        r"^env\.num_env: unknown key\. Did you mean 'num_envs'\?",
        r"^env\.transforms\.object_pointz: unknown transform\..*'object_points'\?",
        r"^env\.transforms\.future_window\.horizons: unknown argument\..*'horizon'\?",
    ):
        assert [p for p in found if re.search(pattern, p)], (pattern, found)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("ablation=no_futur", "Did you mean 'no_future'?"),
        ("ablation=[no_points,no_futur]", "ablation=no_futur"),
        ("env.num_envs=0", "env.num_envs: 0 must be at least 1"),
        ("env.num_envs=true", "env.num_envs: expected an integer"),
        ("env.num_envs=1.5", "env.num_envs: expected an integer"),
        ("env.max_seconds=nan", "env.max_seconds: expected a finite number, found nan"),
        ("train.wall_limit_s=inf", "wall_limit_s: expected a finite number, found inf"),
        ("env.max_seconds='5'", "env.max_seconds: expected a number, found '5'"),
        ("env.rsi=1", "env.rsi: expected true or false, found 1"),
        ("logger.kind=[csv,wndb]", "logger.kind: item 1: 'wndb' is not allowed. Did"),
        ("expect=[{metric: a}]", "expect[0].at_env_steps: missing; every recipe must"),
        ("hand=xhnad", "Did you mean 'xhand'?"),
        ("physics.engine=gpu", "physics.engine: 'gpu' is not allowed"),
        ("physics.condim=5", "physics.condim: 5 is not allowed. Allowed: 3, 4, 6."),
        ("~env.transforms.contacts", "Did you mean 'contact'?"),
        ("env.rewards.object_points.sigma=0", "must be greater than 0"),
        ("seed=0,1", "-m"),
        ("a b", "not understood"),
        ("algo.future_channels=[8,8]", "three positive numbers"),
        ("physics.decimation=2", "set physics.timestep=0.0083333333"),
        ("algo.min_buffer=600000", "never fit in algo.buffer_size"),
        ("env.rewards.object_points=null", "env.terminations.early_reset"),
        ("+env.transforms.mine._target_=os.system", "env.transforms.mine: unknown"),
        ("env.rewards.wrist_pos._target_=os.system", "never classes"),
        ("env.transforms=null", "env.transforms: expected names"),
        ("motions.source=null", "motions: neither library nor source"),
        ("expect=[{metric: a, at_env_steps: 5}]", "expect[0]: give min, max or both"),
    ],
)
def test_a_wrong_override_names_its_place(override, expected):
    assert expected in "\n".join(problems_of("quickstart", [override]))


def test_wrong_values_and_what_does_not_fit_together_are_one_report():
    found = problems_of(
        "quickstart",
        [
            "total_env_steps=many",
            "physics.decimation=2",
            "env.num_envs=1e99",
            "seed=3e0",
        ],
    )
    assert found[0] == "total_env_steps: expected an integer, found 'many'"
    assert any(p.startswith("physics.timestep: 2 substeps of") for p in found)
    assert not any(p.startswith("seed") for p in found)


def test_deleting_a_transform_keeps_the_order_of_the_others():
    base = list(compose("quickstart").env.transforms)
    base.remove("future_window")
    changed = compose("quickstart", ["~env.transforms.future_window"])
    assert list(changed.env.transforms) == base


def test_ablations_combine():
    both = compose("bench50_xhand", ["ablation=[no_points,no_interaction]"])
    one = compose("bench50_xhand", ["ablation=no_points_no_interaction"])
    assert both.env == one.env
    assert both.ablation == "no_points+no_interaction"


def test_an_option_can_be_set_on_a_part_that_is_off():
    recipe = compose("quickstart", ["env.rewards.object_pose.beta_pos=3"])
    assert recipe.env.rewards["object_pose"] == {
        "weight": 1.0,
        "beta_pos": 3.0,
        "beta_rot": 1.0,
    }


def test_ablation_before_self_is_refused(write_recipe):
    path = write_recipe(
        "defaults: [{motions: procedural}, {ablation: none}, _self_]\n"
        "total_env_steps: 1_000_000"
    )
    assert any("'_self_' must stand before" in p for p in problems_of(path))


def test_optional_ablation_is_refused(write_recipe):
    path = write_recipe(
        "defaults: [_self_, {optional ablation: none}]\n"
        "total_env_steps: 1_000_000\nmotions: {source: procedural}"
    )
    assert any("'optional' hides" in p for p in problems_of(path))


def test_broken_yaml_is_a_recipe_error(write_recipe):
    assert problems_of(write_recipe("total_env_steps: [1, 2"))


def test_a_required_value_is_asked_for(write_recipe):
    found = problems_of(write_recipe("motions: {source: procedural}"))
    assert found == ["total_env_steps: missing; every recipe must give it"]


def test_unknown_recipe_lists_the_known_ones():
    with pytest.raises(UnknownRecipeError, match="quickstart"):
        compose("quickstrat")
    with pytest.raises(FlashdexError, match="no such file"):
        compose("nowhere/quickstart.yaml")


@pytest.mark.parametrize(
    "code",
    [
        "import flashdex.recipe.store",
        "import flashdex.reports.run.terminal",
        "from flashdex.cli.main import main; assert main(['ls']) == 0",
        "from flashdex.cli.main import main; assert main(['report', 'nowhere']) == 2",
    ],
)
def test_verbs_that_only_read_start_without_torch(code):
    heavy = "{'torch', 'mujoco', 'torchrl', 'pydantic'}"
    code = f"import sys; {code}; assert not {heavy} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=RECIPES.parent)
    assert done.returncode == 0


def test_local_recipes_come_before_the_packaged_ones(tmp_path, monkeypatch):
    (tmp_path / "recipes").mkdir()
    text = (RECIPES / "quickstart.yaml").read_text()
    changed = text.replace("count: 4", "count: 3")
    (tmp_path / "recipes" / "quickstart.yaml").write_text(changed)
    monkeypatch.chdir(tmp_path)
    recipe = compose("quickstart", ["ablation=no_contact"])
    assert recipe.motions.count == 3
    assert recipe.env.transforms["contact"] is None


def test_a_dumped_recipe_reads_back_equal(tmp_path):
    recipe = compose("bench50_xhand", ["ablation=no_points", "seed=3"])
    dump_recipe(recipe, tmp_path / "recipe.yaml")
    assert load_recipe(tmp_path / "recipe.yaml") == recipe
    assert load_recipe(tmp_path / "recipe.yaml", ["seed=4"]).seed == 4
    assert compose(tmp_path / "recipe.yaml") == recipe
    assert validate(recipe) == recipe


def test_overrides_on_a_composed_recipe():
    recipe = compose("quickstart")
    assert override_recipe(recipe, ["seed=5"]) == dataclasses.replace(recipe, seed=5)
    with pytest.raises(RecipeError, match=r"env\.num_env: unknown"):
        override_recipe(recipe, ["env.num_env=5"])


def test_multirun_is_the_product_in_numbered_folders():
    runs = compose_runs("quickstart", ["seed=0,1", "ablation=none,no_future"])
    found = [(r.seed, r.ablation, r.run_dir) for r in runs]
    assert found == [
        (0, "none", "runs/quickstart-grid/0"),
        (0, "no_future", "runs/quickstart-grid/1"),
        (1, "none", "runs/quickstart-grid/2"),
        (1, "no_future", "runs/quickstart-grid/3"),
    ]


def leaves(data, path=()):
    """Yield (path, value) of everything a YAML file states, `defaults` left out."""
    for key, value in data.items():
        if key == "defaults":
            continue
        if isinstance(value, dict) and value:
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def default_of(path):
    """Look a path up in the schema's defaults, options of named parts included."""
    recipe = GymRecipe(
        name="any", total_env_steps=10**9, gym=GymConfig(env_id="Any-v0")
    )
    if path[0] != "gym":
        motions = MotionsConfig(source="procedural")
        recipe = validate(Recipe(name="any", total_env_steps=10**9, motions=motions))
    node = dataclasses.asdict(recipe)
    for key in path:
        node = node.get(key, None) if isinstance(node, dict) else None
    return node


@pytest.mark.parametrize(
    "file", [*sorted(RECIPES.glob("*.yaml")), *GROUPS], ids=lambda p: p.stem
)
def test_no_recipe_repeats_a_default(file):
    text = file.read_text()
    package = re.search(r"@package (\S+)", text)
    group = package[1] if package else file.parent.name
    is_global = file.parent == RECIPES or group == "_global_"
    prefix = () if is_global else (group,)
    for path, value in leaves(yaml.safe_load(text) or {}, prefix):
        if path in (("motions", "source"), ("total_env_steps",)):
            continue  # required: there is no default to repeat
        if value == {}:
            continue  # turns a part on that is off, see below
        assert value != default_of(path), f"{'.'.join(path)} repeats the default"


def test_the_default_check_can_fail():
    assert default_of(("algo", "gamma")) == 0.98
    assert default_of(("gym", "num_envs")) == 1
    assert default_of(("env", "rewards", "object_points", "rho")) == 0.058
    assert list(leaves({"a": {"b": 1}, "defaults": [1]})) == [(("a", "b"), 1)]


@pytest.mark.parametrize("name", NAMES)
def test_recipe_headers_say_what_needs_and_launch(name):
    head = (RECIPES / f"{name}.yaml").read_text().split("defaults:")[0]
    assert all(line.startswith("#") for line in head.strip().splitlines())
    for word in ("Needs:", "Launch:", f"flashdex train {name}", "Ablate:"):
        assert word in head


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablations_are_short_and_global(name):
    lines = (RECIPES / "ablation" / f"{name}.yaml").read_text().splitlines()
    assert lines[0] == "# @package _global_"
    assert len(lines) <= 10


def test_closed_sets_agree_with_their_owners():
    gains = get_type_hints(PhysicsConfig)["gains"]
    assert set(get_args(gains)) == set(get_args(GainsPreset))
    assert set(CRITERIA) <= set(criterion_names())


def test_every_option_is_documented():
    for term in [term for kind in KINDS for term in registry(kind).values()]:
        assert term.about
        for field in dataclasses.fields(term.options):
            assert field.metadata["text"], f"{term.name}.{field.name}"


def test_a_world_is_one_word_over_recipe_and_engine():
    careful = compose("quickstart").physics
    assert careful == compose("quickstart", ["world=careful"]).physics
    friendly = compose("quickstart", ["world=friendly"]).physics
    assert (friendly.object_friction, friendly.torsional_friction) == (2.0, 0.05)
    assert careful.object_friction < careful.friction < friendly.object_friction
    hard = compose("quickstart", ["world=hard", "physics.friction=0.6"]).physics
    assert (hard.friction, hard.solver, hard.gravcomp) == (0.6, "cg", 0.0)
    step = careful.timestep * careful.decimation
    assert hard.timestep * hard.decimation == pytest.approx(step, rel=1e-9)
    # what the recipe replicates is said in it, and a word still changes it
    assert compose("bench50_xhand").physics.object_friction == 2.0
    assert compose("bench50_xhand", ["world=careful"]).physics.object_friction == 0.5


def test_what_has_no_world_or_solver_says_so():
    with pytest.raises(RecipeError, match="physics: belongs to recipes with task"):
        compose("gym_halfcheetah_small", ["world=careful"])
    with pytest.raises(RecipeError, match="pgs is not available with"):
        compose("quickstart", ["physics=warp", "physics.solver=pgs"])
