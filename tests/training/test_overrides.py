"""Overrides at a resume or an evaluation: taken, or refused before anything changes."""

from __future__ import annotations

import dataclasses
import json

import pytest

from flashdex.algorithms.config import AlgoConfig
from flashdex.cli.main import main
from flashdex.errors import RunError
from flashdex.recipe import Recipe, dump_recipe
from flashdex.system.files import run_lock
from flashdex.system.run_files import RECIPE, new_run
from flashdex.system.tensors import write_tensors
from flashdex.training.checkpoint import RESUMED, load_checkpoint
from flashdex.training.run_dir import resume
from flashdex.training.session import refuse_changes

CHANGES = {
    "algo.kind": "ppo",
    "algo.groups": "unified",
    "algo.v_max": "3.0",
    "algo.head": "unit",
    "algo.critic_action": "own",
    "algo.num_atoms": "21",
    "algo.noise_clock": "per_env_hand",
}
RUN = Recipe(name="tiny", total_env_steps=100)


def content(run_dir):
    return {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}


@pytest.mark.parametrize("keys", [[key] for key in CHANGES] + [list(CHANGES)])
def test_what_would_be_another_algorithm_is_refused_at_a_resume(train_tiny, keys):
    run_dir = train_tiny()
    kept = content(run_dir)
    with pytest.raises(RunError, match="cannot change in a running run") as error:
        resume(run_dir, [f"{key}={CHANGES[key]}" for key in keys])
    for key in CHANGES:
        named = f"{key} from " in str(error.value)
        assert named == (key in keys)
    assert content(run_dir) == kept


@pytest.mark.parametrize("key", CHANGES)
def test_ppo_does_not_mind_what_it_does_not_read(key):
    name, value = key.removeprefix("algo."), CHANGES[key]
    value = type(getattr(AlgoConfig(), name))(value)
    was = dataclasses.replace(RUN, algo=AlgoConfig(kind="ppo"))
    settings = {"kind": "ppo", name: "flashsac" if name == "kind" else value}
    now = dataclasses.replace(RUN, algo=AlgoConfig(**settings))
    refuse_changes(dump_recipe(was), was)
    if name in ("kind", "groups", "v_max"):
        with pytest.raises(RunError, match=key):
            refuse_changes(dump_recipe(was), now)
    else:
        refuse_changes(dump_recipe(was), now)


def test_an_evaluation_takes_another_number_of_worlds(train_tiny, capsys):
    run_dir = train_tiny()
    found = []
    for overrides in ([], ["env.num_envs=4"], ["env.num_envs=9"]):
        assert main(["evaluate", str(run_dir), *overrides]) == 0
        found.append(json.loads((run_dir / "evaluation.json").read_text()))
    assert found[0] == found[1] == found[2]
    assert len(found[0]["motions"]) > 1


def test_an_evaluation_with_other_networks_is_refused_in_one_line(train_tiny, capsys):
    run_dir = train_tiny()
    assert main(["evaluate", str(run_dir), "algo.critic_width=32"]) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith("flashdex evaluate: the checkpoint does not fit")
    assert "[4, 32, " in message  # towers, width
    assert not (run_dir / "evaluation.json").exists()


def test_a_resume_asks_for_exactly_what_a_checkpoint_holds(train_tiny):
    run_dir = train_tiny()
    state = load_checkpoint(run_dir)
    assert set(state) == {
        *RESUMED,
        "format",
        "sealed",
        "run",
        "records",
        "env_steps_lost",
    }
    (path,) = (run_dir / "checkpoints").glob("*.pt")
    del state["torch_rng"], state["assist_epoch"]
    write_tensors(state, run_dir, "checkpoints", path.name)
    with pytest.raises(RunError, match=r"lacks assist_epoch, torch_rng\."):
        resume(run_dir)


def start(folder, **fields):
    with new_run(folder, dump_recipe(dataclasses.replace(RUN, **fields))):
        return (folder / RECIPE).read_text()


def test_a_new_run_needs_a_folder_of_its_own(tmp_path):
    with run_lock(tmp_path), pytest.raises(RunError, match="another process"):
        start(tmp_path)
    assert not (tmp_path / RECIPE).exists()
    text = start(tmp_path)
    with pytest.raises(RunError, match="already holds a run"):
        start(tmp_path, seed=9)
    assert (tmp_path / RECIPE).read_text() == text
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot be written"):
        start(tmp_path / "file")


def test_a_new_run_is_held_while_it_trains(tmp_path):
    with (
        new_run(tmp_path, dump_recipe(RUN)),
        pytest.raises(RunError, match="another process"),
    ):
        start(tmp_path, seed=9)
    assert f"seed: {RUN.seed}\n" in (tmp_path / RECIPE).read_text()
