"""The command: exit codes, messages on stderr, no traceback for a user's mistake."""

from __future__ import annotations

import errno
import os
import tomllib
from pathlib import Path

import pytest
import yaml

import flashdex
from flashdex.cli.doctor import Finding, examine
from flashdex.cli.main import main
from flashdex.system.jsonl import write_object
from flashdex.system.run_files import VERSIONS, write_recipe

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(capsys):
    def call(*argv):
        try:
            code = main(argv)
        except SystemExit as stop:  # argparse's way out
            code = stop.code
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, captured.out, captured.err

    return call


def test_ls_shows_every_recipe_and_its_promise(run):
    code, out, _ = run("ls")
    assert code == 0
    for path in (ROOT / "recipes").glob("*.yaml"):
        assert path.stem in out
    assert "convert/nontrivial >= 40 at 300,000,000 env steps" in out


def test_a_user_error_is_two_and_goes_to_stderr(run):
    code, out, err = run("train", "quickstrat")
    assert (code, out) == (2, "")
    assert err.startswith("flashdex train: ")
    assert "Did you mean 'quickstart'?" in err


@pytest.mark.parametrize("words", [["train", "--debug"], ["--debug", "train"]])
def test_debug_shows_the_traceback(words):
    with pytest.raises(flashdex.errors.FlashdexError):
        main([*words, "quickstrat"])


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        ([], "give a verb. Verbs: doctor, ls, "),
        (["--verison"], "unknown: --verison. Verbs: doctor, ls, "),
        (["trian"], "Did you mean 'train'?"),
        (["TRAIN"], "Did you mean 'train'?"),
        (["ls", "--jsno"], "unknown: --jsno. Did you mean '--json'?"),
        (["validate", "quickstart", "--all"], "unknown: --all"),
        (["evaluate"], "required: RUN\n"),
        (["cp", "quickstart.yml", "x"], "Did you mean 'quickstart'?"),
        (["train", "ablation/ppo"], "It is an option: add ablation=ppo to a recipe"),
        (["cp", "ablations/no_futur", "x"], "Did you mean 'ablation/no_future'?"),
        (["fetch", "myodm", "--wheel", "/nowhere"], "there is no file /nowhere"),
        (["train"], "give a recipe"),
        (["train", "quickstart", "--lr", "3"], "key=value, without dashes"),
        (["ls", "something"], "unknown: something"),
        (["train", "quickstart", "env.num_env=3"], "Did you mean 'num_envs'?"),
        (["train", "quickstart", "num_envs=3"], "Did you mean 'env.num_envs'?"),
        (["train", "quickstart", "motions.select=[]"], "expected at least 1 entries"),
        (["train", "quickstart", "algo.lr=3k"], "1 problem\n  1. algo.lr: expected"),
        (["train", "quickstart", "algo.init_std=1.0"], "must be at most 0.99"),
        (["train", "quickstart", "algo.init_std=0.0067"], "must be at least 0.007"),
        (["train", "--resume", "/nowhere"], "not a run directory"),
        (["train", "--resume", "/nowhere", "--cfg", "job"], "not a run directory"),
        (["train", "--resume", "/nowhere", "-m", "seed=0,1"], "not allowed with"),
        (["validate", "/nowhere/x.yaml"], "no such file"),
        (["score", "/nowhere/x.npz"], "no such file"),
        (["score"], "required"),
        (["report", "/nowhere"], "not a run directory"),
        (["replay", "/nowhere"], "not a run directory"),
        (["replay", "/nowhere", "more"], "unknown: more"),
    ],
)
def test_mistakes_exit_two(run, argv, expected):
    code, _, err = run(*argv)
    assert code == 2
    assert expected in err


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.EIO, "Input/output error", "runs/a"), "error: 'runs/a'"),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left"),
        (MemoryError(), "no memory is left"),
    ],
)
def test_a_machine_that_fails_is_told_in_one_line(run, monkeypatch, error, told):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("flashdex.recipe.compose", fail)
    code, out, err = run("baselines", "quickstart")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("flashdex baselines: disk or memory failed: ")
    assert told in err
    with pytest.raises(type(error)):
        main(["baselines", "quickstart", "--debug"])


def test_cfg_prints_a_complete_recipe_for_each_run(run):
    code, out, _ = run("train", "quickstart", "-m", "seed=0,1", "--cfg", "job")
    assert code == 0
    found = list(yaml.safe_load_all(out))
    assert [recipe["seed"] for recipe in found] == [0, 1]
    assert found[0]["env"]["rewards"]["object_points"]["rho"] == 0.058


def test_overrides_may_stand_behind_flags(run):
    code, out, _ = run("train", "quickstart", "--cfg", "job", "seed=7", "hand=xhand")
    assert code == 0
    assert yaml.safe_load(out)["seed"] == 7


def test_cfg_at_a_resume_prints_the_stored_recipe_and_starts_nothing(run, tmp_path):
    path = tmp_path / "recipe.yaml"
    write_object({"run": "0" * 32}, tmp_path, VERSIONS)
    write_recipe(tmp_path, run("train", "quickstart", "seed=5", "--cfg", "job")[1])
    argv = ("train", "--resume", str(tmp_path), "algo.lr=2e-3", "--cfg", "job")
    code, out, _ = run(*argv)
    assert code == 0
    expected = yaml.safe_load(path.read_text())
    assert expected["algo"]["lr"] != 2e-3
    expected["algo"]["lr"] = 2e-3
    assert yaml.safe_load(out) == expected
    assert {*tmp_path.iterdir()} == {path, tmp_path / VERSIONS}


def test_cp_then_validate(run, tmp_path):
    code, out, _ = run("cp", "quickstart", str(tmp_path))
    assert code == 0
    copy = Path(out.strip())
    assert copy == tmp_path / "quickstart.yaml"
    assert run("validate", str(copy))[0] == 0
    assert run("cp", "quickstart", str(tmp_path))[0] == 2  # never overwrites
    copy.write_text(copy.read_text().replace("num_envs", "num_env"))
    code, _, err = run("validate", str(tmp_path), "bench50_xhand")
    assert code == 2
    assert "env.num_env: unknown key" in err


def test_the_folder_of_a_run_is_no_recipe(run, tmp_path):
    (tmp_path / "recipe.yaml").write_text("seed: 1")
    code, _, err = run("train", f"{tmp_path}/")
    assert code == 2
    assert f"whose recipe is {tmp_path}/recipe.yaml." in err


def test_a_folder_that_was_removed_under_us_hides_no_recipes(
    run, tmp_path, monkeypatch
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "here").rmdir()
    code, out, _ = run("ls")
    assert (code, "quickstart" in out) == (0, True)
    code, _, err = run("cp", "quickstart", "x.yaml")
    assert (code, "cannot be written" in err) == (2, True)


def test_cp_below_a_file_says_so(run, tmp_path):
    (tmp_path / "file").write_text("mine")
    code, _, err = run("cp", "quickstart", str(tmp_path / "file/x"))
    assert code == 2
    assert "cannot be written" in err


def test_processes_of_a_command_import_nothing_from_the_folder_we_are_in(
    run, monkeypatch
):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    run("ls")
    assert os.environ["PYTHONSAFEPATH"] == "1"


def test_doctor_looks_at_everything():
    findings = list(examine())
    subjects = {finding.what for finding in findings}
    assert {"python", "cpu", "gpu", "graphics", "disk"} <= subjects
    assert str(Finding("missing", "torch", "run: pip")).startswith("MISSING  torch ")
    assert all(str(f).split()[0] in ("ok", "note", "MISSING") for f in findings)


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == flashdex.__version__
    assert f"## [{flashdex.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
