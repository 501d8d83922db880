"""Runs on stock environments that are stopped, refused or fed with NaN."""

from __future__ import annotations

import dataclasses
import errno
import math
import os
import shutil
import signal
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gym_runs import read_metrics, tiny_recipe, trainer_of

from flashdex.cli.main import main
from flashdex.errors import FlashdexError, RunError
from flashdex.replay import disk
from flashdex.system.files import LOCK, run_lock
from flashdex.system.run_files import DUMP
from flashdex.system.tensors import write_tensors
from flashdex.training import checkpoint
from flashdex.training.checkpoint import newest_checkpoint
from flashdex.training.guard import GradientGuard, NonFiniteError
from flashdex.training.run_dir import evaluate, reopen, resume, train
from flashdex.training.session import ended_by
from flashdex.training.tasks.gym import SEED_OFFSET

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


class Glitch(gymnasium.Env):
    """Random observations and a reward of 1; something goes wrong in one step.

    Its step number ``at`` has the reward NaN, the observation NaN, or the observation
    NaN and the end of the episode; or, in an evaluation, it brings SIGTERM.
    """

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, fault, at=7):
        self.fault, self.at, self.steps, self.evaluates = fault, at, 0, False

    def _look(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.evaluates = self.evaluates or (seed is not None and seed >= SEED_OFFSET)
        return self._look(), {}

    def step(self, action):
        self.steps += 1
        seen, now = self._look(), self.steps == self.at
        if now and self.fault in ("state", "end"):
            seen[0] = math.nan
        if now and self.fault == "signal" and self.evaluates:
            signal.raise_signal(signal.SIGTERM)
        reward = math.nan if now and self.fault == "reward" else 1.0
        return seen, reward, now and self.fault == "end", False, {}


for name in ("reward", "state", "end", "signal"):
    gymnasium.register(f"Glitch-{name}-v0", Glitch, kwargs={"fault": name})


class Writer:
    """Calls a function at every record."""

    def __init__(self, call):
        self.call = call

    def write(self, record):
        self.call()

    def close(self):
        pass


@pytest.fixture
def make_recipe(tmp_path):
    def make(*args, **kwargs):
        return tiny_recipe(tmp_path / "run", *args, **kwargs)

    return make


@pytest.mark.parametrize(
    ("fault", "n_step", "dropped", "evaluated"),
    [("reward", 1, 1, 19), ("reward", 3, 3, 19), ("state", 1, 1, 7), ("end", 1, 0, 7)],
)
def test_one_nan_costs_its_rows_only(
    fault, n_step, dropped, evaluated, make_recipe, tmp_path
):
    recipe = make_recipe(
        f"Glitch-{fault}-v0", algo={"n_step": n_step, "min_buffer": 60}
    )
    trainer = trainer_of(recipe, tmp_path)
    assert trainer.run() == "budget"
    learner = trainer.learner
    assert learner.num_dropped == dropped
    assert learner.num_rows == 120 - (n_step - 1)
    assert learner.updates > 0
    rows = learner.buffer[:].values(True, True)
    assert all(value.isfinite().all() for value in rows)
    # 20 rewards of 1 in a row, discounted; a NaN is none of them
    gamma, normalizer = recipe.algo.gamma, learner.agent.normalizer
    assert normalizer.count.item() == 120 - (fault == "reward")
    peak = (1 - gamma**20) / (1 - gamma)
    assert normalizer.returns_max.item() == pytest.approx(peak)
    records = read_metrics(trainer.run_dir)
    assert all(math.isfinite(v) for r in records for v in r.values())
    assert records[-1]["buffer/dropped"] == dropped
    assert records[-1]["eval/return"] == evaluated
    again = trainer_of(recipe, tmp_path / "again").learner
    again.load_state_dict(learner.state_dict())
    assert again.num_dropped == dropped


@pytest.mark.parametrize("part", ["actor_network", "target_qvalue_network"])
@pytest.mark.parametrize("seconds", [1e-6, 1e6])
def test_weights_that_are_not_finite_end_the_run(part, seconds, make_recipe, tmp_path):
    recipe = make_recipe(train={"checkpoint_every_s": seconds})
    trainer = trainer_of(recipe, tmp_path)
    network = getattr(trainer.learner.agent.loss, part)

    def poison():
        next(network.parameters()).data.fill_(math.nan)

    trainer.log.writers.append(Writer(poison))  # the first record is that of step 50
    with pytest.raises(RunError, match="not finite after") as caught:
        trainer.run()
    saves = seconds < 1
    good = f"checkpoints/{49:012d}.pt" if saves else "none"
    assert f"newest good one is {good}." in str(caught.value)
    assert f"--resume {trainer.run_dir} algo.lr=" in str(caught.value)
    assert newest_checkpoint(trainer.run_dir) == good
    # the save of that step finds it, or else the first update, a quarter a step from 60
    assert trainer.env_steps == (50 if saves else 63)


def test_a_signal_ends_the_run_with_a_checkpoint(make_recipe, tmp_path):
    trainer = trainer_of(make_recipe(eval_every_env_steps=30), tmp_path)
    trainer.log.writers.append(Writer(lambda: signal.raise_signal(signal.SIGTERM)))
    assert trainer.run() == "signal"
    assert trainer.env_steps == 30
    assert newest_checkpoint(trainer.run_dir) == f"checkpoints/{30:012d}.pt"


def test_a_signal_ends_an_evaluation(make_recipe, tmp_path):
    long = {"max_episode_steps": 10**8, "eval_every_env_steps": 30}
    trainer = trainer_of(make_recipe("Glitch-signal-v0", **long), tmp_path)
    assert trainer.run() == "signal"
    assert newest_checkpoint(trainer.run_dir) == f"checkpoints/{30:012d}.pt"
    (record,) = read_metrics(trainer.run_dir)
    assert record["env_steps"] == 30
    assert "eval/return" not in record


def test_a_wall_limit_ends_the_run(make_recipe, tmp_path):
    trainer = trainer_of(make_recipe(train={"wall_limit_s": 1e-6}), tmp_path)
    assert trainer.run() == "wall_limit_s"
    assert trainer.env_steps == 0


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_run(
    make_recipe, tmp_path, monkeypatch
):
    trainer = trainer_of(make_recipe(train={"checkpoint_every_s": 1e-6}), tmp_path)

    def fail(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_tensors", fail)
    # room again at the record of step 50, by when 49 attempts have failed
    trainer.log.writers.append(Writer(monkeypatch.undo))
    assert trainer.run() == "budget"
    assert newest_checkpoint(trainer.run_dir) == f"checkpoints/{120:012d}.pt"


def test_a_finished_run_does_nothing_when_resumed(make_recipe):
    folder = train(make_recipe())
    wanted = ["metrics.jsonl", f"checkpoints/{120:012d}.pt"]
    before = [(folder / name).read_bytes() for name in wanted]
    resume(folder)
    assert [(folder / name).read_bytes() for name in wanted] == before
    assert newest_checkpoint(folder) == f"checkpoints/{120:012d}.pt"


class Unbounded(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)


gymnasium.register("Unbounded-v0", Unbounded)


@pytest.mark.parametrize(
    ("env_id", "expected"),
    [
        ("HalfCheeta-v4", "HalfCheetah"),
        ("HalfCheetah-v99", "cannot be made"),
        ("CartPole-v1", "only continuous actions"),
        ("FrozenLake-v1", "only flat vectors"),
        ("Unbounded-v0", "gym.rescale_actions=false"),
        ("Glitch-signal-v0", "Set gym.max_episode_steps="),
    ],
)
def test_environments_that_cannot_be_used_exit_two(env_id, expected, tmp_path, capsys):
    folder = tmp_path / "run"
    words = [f"gym.env_id={env_id}", f"run_dir={folder}"]
    assert main(["train", "gym_halfcheetah_small", *words]) == 2
    err = capsys.readouterr().err
    assert err.startswith("flashdex train: gym.")
    assert expected in err
    assert not folder.exists()


def test_the_missing_package_is_named_with_its_extra(monkeypatch, make_recipe):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(FlashdexError, match=r"pip install '\.\[gym\]'"):
        train(make_recipe())


def test_changed_networks_do_not_resume(make_recipe, capsys):
    folder = train(make_recipe())
    before = (folder / "recipe.yaml").read_text()
    words = [str(folder), "algo.critic_width=24"]
    for verb in (["train", "total_env_steps=200", "--resume"], ["evaluate"]):
        assert main([*verb, *words]) == 2
        err = capsys.readouterr().err
        assert "does not fit the recipe" in err
        assert err.count("size mismatch") == 1  # of dozens
    assert (folder / "recipe.yaml").read_text() == before


# what a run on a stock environment shares with every other


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder of a finished run with two checkpoints and its rows; to be copied."""
    train_settings = {"checkpoint_replay": True}
    folder = tmp_path_factory.mktemp("whole") / "run"
    train(tiny_recipe(folder, train=train_settings))
    resume(folder, ["total_env_steps=160"])
    return folder


@pytest.fixture
def ended(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "ended"))


def change_newest(run_dir, change):
    path = max((run_dir / "checkpoints").glob("*.pt"))
    state = torch.load(path)
    change(state)
    write_tensors(state, path.parent, path.name)


def content(run_dir):
    return {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    "change", ["algo.head=centred", "algo.num_atoms=21", "algo.v_max=3.0", "seed=4"]
)
def test_a_resume_refuses_what_would_be_another_algorithm(ended, change):
    kept = content(ended)
    key = change.split("=")[0]
    with pytest.raises(RunError, match=f"cannot change in a running run: {key} from"):
        resume(ended, [change, "total_env_steps=200"])
    assert content(ended) == kept


def test_a_run_is_not_begun_in_a_folder_that_somebody_holds(make_recipe):
    recipe = make_recipe()
    folder = Path(recipe.run_dir)
    folder.mkdir()
    with run_lock(folder), pytest.raises(RunError, match="another process"):
        train(recipe)
    assert [p.name for p in folder.iterdir()] == [LOCK]


def test_a_step_that_the_device_skipped_ends_the_run(make_recipe, tmp_path):
    trainer = trainer_of(make_recipe(), tmp_path)
    trainer.guard = GradientGuard(waits=False)

    def poison():
        trainer.guard._flag = torch.ones(())

    trainer.log.writers.append(Writer(poison))
    with pytest.raises(RunError, match="skipped on the device"):
        trainer.run()
    assert trainer.env_steps == 100  # the record after that of step 50
    assert newest_checkpoint(trainer.run_dir) == "none"


def test_a_damaged_checkpoint_gives_way_to_the_one_before(ended, caplog):
    newest = max((ended / "checkpoints").glob("*.pt"))
    os.truncate(newest, newest.stat().st_size // 2)
    resume(ended, ["total_env_steps=200"])
    assert f"{newest.name} cannot be used" in caplog.text
    assert newest.with_suffix(".unreadable").is_file()
    assert read_metrics(ended)[-1]["env_steps"] == 200
    assert read_metrics(ended)[-1]["env_steps_lost"] == 40


@pytest.mark.parametrize("fault", ["groups", "number", "absent"])
def test_a_checkpoint_with_another_inside_is_refused(ended, fault):
    def change(state):
        stepper = state["learner"]["agent"]["stepper"]
        if fault == "groups":  # a ValueError of torch
            groups = stepper["critic_optimizer"]["adam"]["param_groups"]
            groups.append(groups[0])
        elif fault == "number":
            stepper["critic_optimizer"] = 3
        else:
            del state["learner"]["agent"]

    change_newest(ended, change)
    for verb in (resume, evaluate):
        with pytest.raises(RunError, match="does not fit the recipe"):
            verb(ended, ["gym.eval_episodes=1"])


def test_a_resume_asks_for_what_it_needs(ended):
    def change(state):
        del state["wall_s"], state["wandb_id"]

    change_newest(ended, change)
    assert evaluate(ended, ["gym.eval_episodes=1"])["env_steps"] == 160
    with pytest.raises(RunError, match=r"lacks wall_s, wandb_id\."):
        resume(ended)


def test_a_checkpoint_of_an_earlier_version_goes_on(ended):
    def change(state):
        for key in ("recipe", "vector_steps", "torch_rng", "env_steps_lost"):
            del state[key]

    change_newest(ended, change)
    before = read_metrics(ended)[-1]
    with pytest.raises(RunError, match=r"algo\.head from"):
        resume(ended, ["algo.head=centred"])
    resume(ended, ["total_env_steps=200"])
    last = read_metrics(ended)[-1]
    assert (last["env_steps"], last["buffer/rows"]) == (200, before["buffer/rows"] + 40)


def test_what_is_not_finite_is_dumped_to_be_repeated(ended, monkeypatch):
    # it is looked at when it is read: as if it came up later
    monkeypatch.setattr(disk, "first_non_finite", lambda state: "")
    for path in (ended / "checkpoints/replay").glob("*.pt"):
        content = torch.load(path)
        content["rows"]["reward"][:] = math.nan
        write_tensors(content, path.parent, path.name)
    with pytest.raises(RunError, match=r"batch entry 'next\.reward'") as caught:
        resume(ended, ["total_env_steps=400"])
    assert DUMP in str(caught.value)
    learner, repeat = reopen(ended / DUMP)
    assert learner.updates >= 25
    with pytest.raises(NonFiniteError):
        repeat()


def test_a_wall_limit_ends_with_an_evaluation(make_recipe):
    rare = {"eval_every_env_steps": 10**9, "train": {"wall_limit_s": 1.0}}
    recipe = dataclasses.replace(make_recipe(**rare), total_env_steps=10**9)
    run_dir = train(recipe)
    records = read_metrics(run_dir)
    assert ended_by(run_dir) == "wall_limit_s"
    assert [r for r in records if "eval/return" in r] == records[-1:]
    newest = newest_checkpoint(run_dir)
    assert f"{records[-1]['env_steps']:012.0f}.pt" in newest
