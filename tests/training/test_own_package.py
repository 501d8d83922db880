"""A run with terms of a package of the user, which has to be allowed."""

from __future__ import annotations

import dataclasses
import json
import sys

import pytest
import yaml

from flashdex.cli.main import main
from flashdex.envs.mdp import term
from flashdex.recipe import dump_recipe, load_recipe

PACKAGE = '''
import torch

from flashdex import keys
from flashdex.envs.mdp import number, observation, reward, termination
from flashdex.envs.transforms.base import Block


@reward("gentle", weight=0.05, gate="imitation")
def gentle(step, *, scale: float = number(1.0, above=0, high=1000)):
    """Slow joints.

    Args:
        scale: Steepness, s/rad.
    """
    return torch.exp(-scale * step.state[keys.JOINT_VEL].abs().mean(-1))


@termination()
def too_long(step, *, steps: int = number(10, low=1, high=10_000)):
    """Long episodes.

    Args:
        steps: Allowed, control steps.
    """
    return (step.steps > steps).unsqueeze(-1).expand(-1, 2)


@observation("age", needs_object=True)
class Age(Block):
    """Height of the object."""

    def features(self, td):
        return td[keys.OWN, "pos"][..., 2:]
'''
TERMS = {
    "rewards": {"gentle": {"_target_": "toy_package.terms.gentle", "weight": 0.5}},
    "terminations": {"long": {"_target_": "toy_package.terms.too_long", "steps": 7}},
    "transforms": {"age": {"_target_": "toy_package.terms.Age"}},
}


pytestmark = pytest.mark.usefixtures("forget_terms")


@pytest.fixture
def recipe_file(start_tiny, tmp_path, monkeypatch):
    """A tiny recipe that names terms of a package on the path."""
    package = tmp_path / "toy_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "terms.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path)
    recipe = load_recipe(start_tiny(tmp_path / "plain") / "recipe.yaml")
    recipe = dataclasses.replace(
        recipe, run_dir=str(tmp_path / "own"), total_env_steps=240
    )
    data = yaml.safe_load(dump_recipe(recipe))
    for kind, own in TERMS.items():
        data["env"][kind] |= own
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    yield path
    for name in [n for n in sys.modules if n.startswith("toy_package")]:
        del sys.modules[name]


def test_terms_of_a_package_are_trained_with_and_logged(recipe_file, capsys):
    allowed = ["--allow", "toy_package"]
    assert main(["validate", str(recipe_file), *allowed]) == 0
    assert main(["train", str(recipe_file), *allowed]) == 0
    run_dir = recipe_file.parent / "own"
    rows = [json.loads(r) for r in (run_dir / "metrics.jsonl").read_text().splitlines()]
    logged = {key for row in rows for key in row}
    assert {f"reward/{side}/gentle" for side in ("left", "right")} <= logged
    ended = [row["episode/long"] for row in rows if "episode/long" in row]
    assert max(ended) > 0.5
    # what is stored names the package and does not allow it
    stored = yaml.safe_load((run_dir / "recipe.yaml").read_text())
    assert stored["env"]["rewards"]["gentle"]["_target_"] == "toy_package.terms.gentle"
    assert "allow" not in (run_dir / "recipe.yaml").read_text()
    term._ALLOWED.discard("toy_package")
    capsys.readouterr()
    for verb in (["evaluate", str(run_dir)], ["train", "--resume", str(run_dir)]):
        assert main(verb) == 2
        assert "--allow toy_package" in capsys.readouterr().err
    more = ["total_env_steps=300", *allowed]
    assert main(["train", "--resume", str(run_dir), *more]) == 0
    assert main(["evaluate", str(run_dir), *allowed]) == 0


@pytest.mark.parametrize("verb", ["validate", "train", "doctor"])
def test_they_are_refused_without_permission(recipe_file, capsys, verb):
    assert main([verb, str(recipe_file)]) == 2
    error = capsys.readouterr().err
    for name in (
        "env.rewards.gentle",
        "env.terminations.long",
        "env.transforms.age",
    ):
        assert f"{name}: unknown" in error
    assert "add --allow toy_package" in error
    assert "Traceback" not in error
    assert not any(name.startswith("toy_package") for name in sys.modules)
    assert not (recipe_file.parent / "own").exists()
