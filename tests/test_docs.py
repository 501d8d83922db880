"""The pages say what is true: options, logged keys, verbs, files, criteria, columns."""

from __future__ import annotations

import argparse
import csv
import importlib.util
import re
from pathlib import Path

import pytest

from flashdex.cli.main import make_parser
from flashdex.system.jsonl import read_lines

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
CELL = re.compile(r"^\| `([^`]+)`", re.MULTILINE)
# Small enough for seconds, with every part that logs something switched on.
SIZES = {
    "batch_size": 16,
    "buffer_size": 400,
    "min_buffer": 40,
    "n_step": 2,
    "actor_width": 16,
    "critic_width": 16,
    "num_atoms": 11,
    "future_latent": 8,
    "future_channels": [8, 8, 8],
}


def load_script(name):
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def section(page, heading):
    """Text below one heading of a page, up to the next of the same level."""
    text = (DOCS / page).read_text()
    found = re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE)
    assert found, f"{page} has no heading '{heading}'"
    rest = text[found.end() :]
    following = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.MULTILINE)
    return rest[: following.start()] if following else rest


def first_cells(page, heading):
    """Code in the first column of the tables below a heading."""
    return set(CELL.findall(section(page, heading)))


@pytest.fixture(scope="module")
def run_tiny(library, tmp_path_factory):
    """Train for a few steps into a folder of its own; return the folder."""
    from flashdex.algorithms.config import AlgoConfig, PPOConfig
    from flashdex.envs.config import EnvConfig
    from flashdex.envs.mdp.assist import AssistConfig
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.recipe import Recipe, validate
    from flashdex.recipe.motions import MotionsConfig
    from flashdex.recipe.run import TrainConfig
    from flashdex.training.run_dir import train

    def run(groups, kind="flashsac"):
        folder = tmp_path_factory.mktemp("runs") / f"{groups}-{kind}"
        ppo = PPOConfig(horizon=20, hidden=[16])
        env = EnvConfig()
        recipe = Recipe(
            name="tiny",
            total_env_steps=6 * 60,
            run_dir=str(folder),
            motions=MotionsConfig(library=str(library.path)),
            physics=PhysicsConfig(num_threads=1),
            env=EnvConfig(
                num_envs=6,
                attempt_share=0.5,
                finger_mode="residual",
                transforms={**env.transforms, "object_points": {"num_points": 4}},
                rewards={**env.rewards, "object_pose": {}},
                assist=AssistConfig(enabled=True),
            ),
            algo=AlgoConfig(
                kind=kind, groups=groups, updates_per_step=0.2, ppo=ppo, **SIZES
            ),
            train=TrainConfig(certify=False),
        )
        return train(validate(recipe))

    return run


@pytest.fixture(scope="module")
def tiny_run(run_tiny):
    return run_tiny("per_hand")


def logged_keys(run_dir):
    return {key for row in read_lines(run_dir / "metrics.jsonl") for key in row}


def general(key):
    """A logged key as the glossary writes it: one entry for all hands."""
    key = re.sub(r"^(reward|error)/(left|right)/", r"\1/<hand>/", key)
    return re.sub(r"^loss/(left|right|both)/", "loss/<group>/", key)


def test_options_page_is_up_to_date():
    page = (DOCS / "options.md").read_text()
    assert page == load_script("make_options").render(), (
        "run: python docs/make_options.py"
    )


def test_every_link_leads_somewhere():
    check = load_script("check_links")
    assert [line for page in check.pages() for line in check.broken_links(page)] == []


def test_glossary_names_exactly_the_logged_keys(tiny_run, run_tiny):
    logged = logged_keys(tiny_run) | logged_keys(run_tiny("unified"))
    assert any(key.startswith("loss/both/") for key in logged)
    logged |= logged_keys(run_tiny("per_hand", "ppo"))
    assert {general(key) for key in logged} == first_cells("metrics.md", "Glossary")


def test_run_page_names_exactly_the_keys_of_an_attempt(tiny_run):
    from flashdex.rollouts.ledger import STORED

    lines = read_lines(tiny_run / "conversions.jsonl")
    assert lines
    keys = {key for line in lines for key in line}
    # of some lines only, and the seal, which readers leave out
    stored = {*STORED, "sha256"}
    assert keys | stored == first_cells("runs.md", "conversions.jsonl")


def test_run_page_names_every_file(tiny_run):
    named = {name.rstrip("/") for name in first_cells("runs.md", "Files")}
    written = {path.name for path in tiny_run.iterdir()}
    assert written <= named


def test_run_page_names_exactly_the_keys_of_a_rollout():
    import dataclasses

    from flashdex.rollouts.rollout import Rollout

    keys = {field.name for field in dataclasses.fields(Rollout)} | {"schema"}
    assert keys == first_cells("runs.md", "rollouts")


def test_run_page_names_exactly_the_parts_of_a_certificate():
    import dataclasses

    from flashdex.rollouts.certificate import Certificate

    parts = {field.name for field in dataclasses.fields(Certificate)}
    assert parts == first_cells("runs.md", "Certificates")


def test_criteria_page_names_exactly_the_criteria():
    from flashdex.metrics.criteria_table import make_criteria

    names = {criterion.name for criterion in make_criteria()}
    assert names == first_cells("metrics.md", "Criteria")


def test_data_page_names_exactly_the_frame_entries():
    from flashdex.motions.library_format import FRAME_KEYS

    assert set(FRAME_KEYS) == first_cells("data.md", "frames")


def test_data_page_names_exactly_the_codes_of_a_report():
    from flashdex.reports.library.facts import CODES

    code = re.compile(r"\b[EIRW]_[A-Z]{2,}\b")
    folders = ("datasets", "objects", "motions")
    files = [f for n in folders for f in (ROOT / "flashdex" / n).rglob("*.py")]
    written = {name for file in files for name in code.findall(file.read_text())}
    assert written == first_cells("data.md", "Codes")
    assert written == set(CODES)  # the report says what they mean


def test_data_page_names_exactly_the_quality_entries():
    from flashdex.motions.library_format import QUALITY_KEYS

    assert set(QUALITY_KEYS) == first_cells("data.md", "quality")


def test_data_pages_name_every_source():
    from flashdex.datasets import source_names

    (row,) = re.findall(r"^\| `--source` .*", (DOCS / "data.md").read_text(), re.M)
    assert set(re.findall(r"`([a-z]\w+)`", row)) == set(source_names())
    page = (DOCS / "datasets.md").read_text()
    assert set(source_names()) - set(re.findall(r"^## (\w+)$", page, re.M)) == {
        "procedural"
    }


def test_dataset_page_shows_commands_that_parse():
    page = (DOCS / "datasets.md").read_text().replace("\\\n", " ")
    commands = re.findall(r"^flashdex (.+)$", page, re.M)
    assert len(commands) > 10
    for command in commands:
        args = make_parser().parse_args(command.split())
        if args.verb == "prepare":
            missing = [n for n in needs_of(args.source) if getattr(args, n) is None]
            assert not missing, command


def needs_of(source):
    """Options of prepare that a source needs."""
    from flashdex.datasets import get_source

    return ["input" if name == "path" else name for name in get_source(source).needs]


def test_data_page_names_exactly_the_columns_of_a_report(tmp_path):
    from flashdex.datasets.source import SourceOptions
    from flashdex.motions.pipeline.motion import MotionSettings
    from flashdex.motions.pipeline.prepare import Order, run_order

    out, options = tmp_path / "library", SourceOptions(path=Path("pick_sphere_right"))
    settings = MotionSettings(cache_dir=tmp_path / "cache")
    run_order(Order("procedural", options, settings), out, progress=False)
    with (out / "report.csv").open() as file:
        columns = set(next(csv.reader(file)))
    assert columns == first_cells("data.md", "report.csv")


@pytest.mark.parametrize("group", ["", "ablation"])
def test_recipe_page_names_exactly_the_recipes_and_ablations(group):
    names = {path.stem for path in (ROOT / "recipes" / group).glob("*.yaml")}
    cells = first_cells("recipes.md", "Ablations" if group else "Recipes")
    assert cells == names if group else names <= cells


def test_data_page_names_exactly_the_options_of_prepare():
    options = {
        word
        for action in verbs()["prepare"]._actions
        for word in action.option_strings
        if word.startswith("--")
    }
    named = {c for c in first_cells("data.md", "Data") if c.startswith("--")}
    assert named == options - {"--help", "--debug"}


def verbs():
    """Parser of each verb."""
    (found,) = (
        action.choices
        for action in make_parser()._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    return found


def test_readme_names_exactly_the_verbs():
    rows = re.findall(
        r"^\| (`[^|]+) \|", (ROOT / "README.md").read_text(), re.MULTILINE
    )
    named = {word for row in rows for word in re.findall(r"`([a-z]+)`", row)}
    assert named == set(verbs())


def test_extend_page_names_files_that_exist():
    text = (DOCS / "extend.md").read_text()
    named = re.findall(r"`((?:flashdex|recipes|tests|docs)/[\w/.]+)`", text)
    files = {name for name in named if "NAME" not in name}
    assert files
    assert [name for name in sorted(files) if not (ROOT / name).exists()] == []
