"""Runs from anybody, and runs that something happened to: one message, or no harm.

Every file of a run is spoilt in every way of ``hostile`` before a command uses the run.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil

import pytest
import torch
from gym_runs import tiny_recipe
from hostile import (
    CONTENT,
    PLANTED,
    Disk,
    command,
    drawn,
    file_link,
    fingerprint,
    flip_bit,
    pipe,
)

from flashdex.errors import FlashdexError, RunError
from flashdex.recipe import dump_recipe
from flashdex.replay import disk as disk_module
from flashdex.system.files import run_lock
from flashdex.system.jsonl import read_lines, read_object
from flashdex.system.run_files import (
    CHECKPOINTS,
    DUMP,
    EVALUATION,
    FILES,
    FILMS,
    FOLDERS,
    LOCK,
    METRICS,
    RECIPE,
    REPLAY,
    ROLLOUTS,
    read_recipe,
    read_sessions,
    run_id,
)
from flashdex.system.tensors import first_non_finite, read_tensors, write_tensors
from flashdex.training import run_dir as run_dir_module
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.run_dir import reopen, resume, train
from flashdex.training.trainer import Trainer

TIMES = ("perf/", "hours", "convert/per_hour")
INSIDE = {
    CHECKPOINTS: "000000000120.pt",
    REPLAY: "000000000120.json",
    ROLLOUTS: "both.npz",
    FILMS: "both.mp4",
}
NAMES = (
    *FILES,
    *FOLDERS,
    *(f"{folder}/{name}" for folder, name in INSIDE.items()),
    f"{REPLAY}/000000000120-0.pt",
    f"{REPLAY}/000000000999-0.pt",  # one that a resume would delete
    f"{ROLLOUTS}/both.certificate.json",
    f"{CHECKPOINTS}/000000000360.pt",
)


def recipe_of(folder):
    train = {"checkpoint_replay": True, "torch_threads": 1}
    return tiny_recipe(folder, train=train)


@pytest.fixture(scope="module")
def gym_run(tmp_path_factory):
    """A short run with two checkpoints, not to be touched."""
    folder = train(recipe_of(tmp_path_factory.mktemp("whole") / "run"))
    return resume(folder, ["total_env_steps=130"])


@pytest.fixture
def run_dir(gym_run, tmp_path):
    return shutil.copytree(gym_run, tmp_path / "run")


@pytest.fixture
def outside(tmp_path):
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "precious.pt").write_text("precious")
    return folder


def resumed(folder):
    """What a resume came to, times left out."""
    return [
        {k: v for k, v in record.items() if not k.startswith(TIMES)}
        for record in read_lines(folder / METRICS)
    ]


RESUME = ("train", "--resume", None, "total_env_steps=140")
VERBS = {"train": RESUME, "evaluate": ("evaluate", None)}


@pytest.fixture
def use(capsys, caplog):
    """Run a verb on a run."""

    def run(verb, folder, words=None):
        words = words or VERBS[verb]
        return command(capsys, caplog, *(folder if w is None else w for w in words))

    return run


FAST = (file_link, pipe)
PLANTS = [p if p in FAST else pytest.param(p, marks=pytest.mark.slow) for p in PLANTED]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_but_own_files_is_touched(name, plant, run_dir, outside, use, tmp_path):
    plant(run_dir / name, outside)
    foreign, own = fingerprint(outside), fingerprint(run_dir)
    for verb in ("evaluate", "train"):
        found = use(verb, run_dir)
        if found.code != 0:
            assert found.is_one_message(verb), found.told
            assert fingerprint(run_dir).items() <= {**own, LOCK: b""}.items()
        assert fingerprint(outside) == foreign
    # and the same where a new run would be
    shutil.rmtree(outside)
    outside.mkdir()
    plant(tmp_path / "new" / name, outside)
    foreign = fingerprint(outside)
    (tmp_path / "mine.yaml").write_text(dump_recipe(recipe_of(tmp_path / "new")))
    found = use("train", None, ("train", str(tmp_path / "mine.yaml")))
    assert found.code == 0 or found.is_one_message("train"), found.told
    assert fingerprint(outside) == foreign


@pytest.fixture
def disk(monkeypatch, tmp_path):
    return Disk(monkeypatch, tmp_path / "run")


def train_in(folder, use):
    text = dump_recipe(recipe_of(folder))
    (folder.parent / "mine.yaml").write_text(text)
    return use("train", None, ("train", str(folder.parent / "mine.yaml")))


def calls_of_a_run(disk, folder, use):
    """How many calls a whole run makes."""
    disk.fail(lambda n: False, 0)
    assert train_in(folder, use).code == 0
    shutil.rmtree(folder)
    return disk.count


CODES = (errno.ENOSPC, errno.EIO, errno.EROFS)


def check_faulty_disk(disk, folder, use, number, code, *, lasts):
    """A run whose disk fails at a call, or from it on: told, and gone on with."""
    disk.fail((lambda n: n >= number) if lasts else (lambda n: n == number), code)
    found = train_in(folder, use)
    hit = disk.count >= number
    disk.fail(lambda n: False, 0)
    where = (number, errno.errorcode[code], lasts)
    assert found.code == 0 or found.is_one_message("train"), (where, found.told)
    assert not (lasts and hit and found.code == 0 and not found.told), where
    if (folder / RECIPE).exists():
        again = use("train", folder)
        assert again.code == 0, (where, again.told)
    else:
        again = train_in(folder, use)
        assert again.code == 0, (where, again.told)
        use("train", folder)
    assert read_lines(folder / METRICS)[-1]["env_steps"] == 140, where
    assert load_checkpoint(folder)["env_steps"] == 140, where
    shutil.rmtree(folder)


@pytest.mark.parametrize("lasts", [False, True], ids=["once", "from_then_on"])
def test_a_disk_that_fails_anywhere_ends_in_one_message(disk, tmp_path, use, lasts):
    total = calls_of_a_run(disk, tmp_path / "run", use)
    draw = drawn(lasts)
    for number in draw.sample(range(1, total + 1), 3):
        code = draw.choice(CODES)
        check_faulty_disk(disk, tmp_path / "run", use, number, code, lasts=lasts)


@pytest.mark.slow
@pytest.mark.parametrize("code", CODES, ids=lambda c: errno.errorcode[c])
@pytest.mark.parametrize("lasts", [False, True], ids=["once", "from_then_on"])
def test_a_disk_that_fails_at_each_call(disk, tmp_path, use, lasts, code):
    total = calls_of_a_run(disk, tmp_path / "run", use)
    for number in range(1, total + 1):
        check_faulty_disk(disk, tmp_path / "run", use, number, code, lasts=lasts)


def judge(verb, folder, found, whole):
    """``refused``, ``same``, ``told``: what a spoilt file may come to."""
    if found.code != 0:
        assert found.is_one_message(verb), found.told
        return "refused"
    is_same = (resumed(folder) if verb == "train" else found.out) == whole
    assert is_same or "WARNING" in found.told, "another result, and nobody was told"
    return "same" if is_same else "told"


@pytest.fixture(scope="module")
def results():
    """What each verb makes of the run as it is."""
    return {}


def expect(verb, folder, gym_run, use, results):
    """What a verb makes of the run as it is, found out once."""
    if verb not in results:
        other = shutil.copytree(gym_run, folder.parent / "other")
        found = use(verb, other)
        assert found.code == 0
        results[verb] = resumed(other) if verb == "train" else found.out
    return results[verb]


def check_spoilt(folder, name, spoil, gym_run, use, results, verb):
    whole = expect(verb, folder, gym_run, use, results)
    shutil.rmtree(folder)
    shutil.copytree(gym_run, folder)
    spoil(folder / name, drawn(name))
    judge(verb, folder, use(verb, folder), whole)


TEXT = ("recipe.yaml", "versions.json", METRICS, "sessions.jsonl")
BINARY = (f"{CHECKPOINTS}/000000000130.pt", f"{REPLAY}/000000000130-0.pt")
SPOILT = [(n, f) for n in (*TEXT, f"{REPLAY}/000000000130.json") for f in CONTENT]
SPOILT += [(n, f) for n in BINARY for f in CONTENT[:7]]
IDS = [f"{name}-{spoil.__name__}" for name, spoil in SPOILT]


FEW = drawn("few").sample(range(len(SPOILT)), 40)


@pytest.mark.parametrize(
    ("name", "spoil"), [SPOILT[i] for i in FEW], ids=[IDS[i] for i in FEW]
)
def test_a_spoilt_file_is_named_or_does_no_harm(
    name, spoil, run_dir, gym_run, use, results
):
    verb = "train" if name in (*BINARY, "sessions.jsonl", METRICS) else "evaluate"
    check_spoilt(run_dir, name, spoil, gym_run, use, results, verb)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["train", "evaluate"])
@pytest.mark.parametrize(("name", "spoil"), SPOILT, ids=IDS)
def test_spoilt_files_by_every_verb(name, spoil, verb, run_dir, gym_run, use, results):
    check_spoilt(run_dir, name, spoil, gym_run, use, results, verb)


@pytest.mark.parametrize("name", BINARY, ids=["checkpoint", "replay"])
def test_a_flipped_bit_is_found_wherever_it_is(name, run_dir):
    path, draw = run_dir / name, drawn(name)
    whole = path.read_bytes()
    for _ in range(50):
        flip_bit(path, draw)
        with pytest.raises(ValueError, match=r"."):
            read_tensors(path.parent, path.name)
        path.write_bytes(whole)
    assert read_tensors(path.parent, path.name)["sealed"]


def change_checkpoint(run_dir, change):
    path = max((run_dir / CHECKPOINTS).glob("*.pt"))
    state = read_tensors(path.parent, path.name)
    change(state)
    write_tensors(state, path.parent, path.name)  # with a seal that fits
    return path


def spoil_weights(state):
    weights = state["learner"]["agent"]["stepper"]["loss"]
    next(v for v in weights.values() if v.is_floating_point()).view(-1)[0] = math.nan


def moments(state):
    return state["learner"]["agent"]["stepper"]["critic_optimizer"]["adam"]["state"][0]


def spoil_moment(state):
    moments(state)["exp_avg"].view(-1)[0] = math.inf


@pytest.mark.parametrize("spoil", [spoil_weights, spoil_moment])
def test_what_is_not_finite_gives_way_to_the_one_before(spoil, run_dir, use):
    path = change_checkpoint(run_dir, spoil)
    found = use("train", run_dir)
    assert found.code == 0
    assert f"{path.name} cannot be used" in found.told
    assert "is not finite" in found.told
    assert first_non_finite(load_checkpoint(run_dir)["learner"]) == ""
    assert path.with_suffix(".unreadable").exists()


MACHINE = {
    "disk": OSError(errno.EIO, "Input/output error"),
    "memory": MemoryError(),
    "torch": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"),
    "threads": RuntimeError("can't start new thread"),
}


PLACES = {
    "checkpoint": (torch, "load"),
    "rows": (disk_module, "read_tensors"),
    "loop": (Trainer, "vector_step"),
}
FAILS = [("checkpoint", name) for name in MACHINE]
FAILS += [("rows", "disk"), ("rows", "torch"), ("loop", "torch")]


@pytest.mark.parametrize(("place", "failure"), FAILS)
def test_a_machine_that_fails_says_nothing_of_the_files(
    place, failure, run_dir, gym_run, use, monkeypatch, results
):
    left, real = [MACHINE[failure]], getattr(*PLACES[place])

    def fail_once(*args, **kwargs):
        if left:
            raise left.pop()
        return real(*args, **kwargs)

    whole = expect("train", run_dir, gym_run, use, results)
    before = fingerprint(run_dir / CHECKPOINTS)
    with monkeypatch.context() as patch:
        patch.setattr(*PLACES[place], fail_once)
        assert use("train", run_dir).is_one_message("train")
    assert fingerprint(run_dir / CHECKPOINTS) == before
    assert use("train", run_dir).code == 0
    assert resumed(run_dir) == whole


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("env_steps", "130"), ("env_steps", -1), ("env_steps", True)),
        *(("learner", []), ("recipe", 3), ("wall_s", "x"), ("run", "another")),
        *(("torch_rng", [0]), ("wandb_id", 5), ("learner", {})),
    ],
    ids=str,
)
def test_a_checkpoint_of_other_things_is_refused(key, value, run_dir, use):
    change_checkpoint(run_dir, lambda state: state.update({key: value}))
    before = fingerprint(run_dir)
    found = use("train", run_dir)
    assert found.is_one_message("train"), found.told
    assert fingerprint(run_dir) == before


@pytest.mark.parametrize("shape", [(1,), (0,), (3, 3)], ids=str)
def test_moments_of_other_shapes_are_refused(shape, run_dir, use):
    def change(state):
        moments(state)["exp_avg"] = torch.zeros(shape)

    change_checkpoint(run_dir, change)
    found = use("train", run_dir)
    assert found.is_one_message("train"), found.told


def test_a_file_that_runs_code_is_not_run(run_dir, use, tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    for path in [*run_dir.rglob("*.pt")]:
        torch.save({"format": 3, "learner": Trap(), "rows": Trap()}, path)
    torch.save(Trap(), run_dir / "nan_dump.pt")
    for verb in VERBS:
        assert use(verb, run_dir).is_one_message(verb)
    with pytest.raises(RunError, match="not a readable dump"):
        reopen(run_dir / "nan_dump.pt")
    assert not (tmp_path / "sprung").exists()


DUMPED = {
    "code": {"recipe": "_target_: os.mkdir\n"},
    "code_in_a_part": {"recipe": "algo: {_target_: os.mkdir}\n"},
    "tag": {"recipe": "a: !!python/object/apply:os.mkdir [sprung]\n"},
    "no_recipe": {"recipe": None},
    "no_text": {"recipe": 5},
    "no_learner": {"learner": []},
    "no_state": {"torch_rng": [1, 2]},
    "no_batch": {"update": [1]},
    "other_networks": {"learner": {"agent": {}}},
}


@pytest.mark.parametrize("change", DUMPED.values(), ids=DUMPED)
def test_a_forged_dump_is_refused_and_runs_nothing(change, run_dir, monkeypatch):
    monkeypatch.chdir(run_dir)
    dump = {"format": 3, "what": "x", "learner": {}, "update": {}}
    dump |= {"recipe": read_recipe(run_dir), "torch_rng": torch.get_rng_state()}
    dump |= change
    write_tensors({k: v for k, v in dump.items() if v is not None}, run_dir, DUMP)
    with pytest.raises(FlashdexError):
        reopen(run_dir / DUMP)
    assert not (run_dir / "sprung").exists()


# a run is a folder, not a path


def test_a_run_that_is_moved_while_it_trains_stops(run_dir, use, monkeypatch, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    steps = iter(range(100))
    step = Trainer.vector_step

    def move(self, td):
        if next(steps) == 3:
            run_dir.rename(elsewhere)
        return step(self, td)

    monkeypatch.setattr(Trainer, "vector_step", move)
    found = use("train", run_dir)
    assert found.is_one_message("train"), found.told
    assert str(elsewhere) in found.told
    assert not run_dir.exists()  # nor is it made again
    monkeypatch.undo()
    assert use("train", elsewhere).code == 0


def test_another_run_under_the_path_is_left_alone(
    run_dir, gym_run, use, monkeypatch, tmp_path
):
    def exchange(self, td):
        if not (tmp_path / "elsewhere").exists():
            run_dir.rename(tmp_path / "elsewhere")
            shutil.copytree(gym_run, run_dir)
        return step(self, td)

    step = Trainer.vector_step
    monkeypatch.setattr(Trainer, "vector_step", exchange)
    assert use("train", run_dir).is_one_message("train")
    assert fingerprint(run_dir) == fingerprint(gym_run)


def test_a_lock_that_is_removed_lets_nobody_in(run_dir):
    with run_lock(run_dir) as hold:
        (run_dir / LOCK).unlink()
        with pytest.raises(RunError, match="another process"):
            resume(run_dir)
        hold.check()


def test_a_copied_run_is_the_same_run_and_another_is_not(run_dir, tmp_path, use):
    other = train(recipe_of(tmp_path / "other"))
    assert run_id(other) != run_id(run_dir)
    for path in (other / CHECKPOINTS).glob("*.pt"):
        shutil.copy(path, run_dir / CHECKPOINTS / "000000000135.pt")
    found = use("train", run_dir)
    assert found.is_one_message("train")
    assert "another run" in found.told


def test_files_of_a_run_without_its_recipe_are_not_a_new_one(run_dir, use):
    (run_dir / RECIPE).unlink()
    before = fingerprint(run_dir)
    assert train_in(run_dir, use).is_one_message("train")
    assert fingerprint(run_dir) == before


def test_hard_links_of_a_backup_keep_their_content(run_dir, use, tmp_path):
    for path in [p for p in run_dir.rglob("*") if p.is_file()]:
        twin = tmp_path / "backup" / path.relative_to(run_dir)
        twin.parent.mkdir(parents=True, exist_ok=True)
        twin.hardlink_to(path)
    before = fingerprint(tmp_path / "backup")
    assert use("train", run_dir).code == 0
    assert fingerprint(tmp_path / "backup") == before


def test_the_words_of_the_first_session_are_kept(tmp_path, use):
    words = ("seed=3", f"run_dir={tmp_path / 'run'}")
    text = dump_recipe(recipe_of(tmp_path / "run"))
    (tmp_path / "mine.yaml").write_text(text)
    assert use("train", None, ("train", tmp_path / "mine.yaml", *words)).code == 0
    assert read_sessions(tmp_path / "run")[0]["overrides"] == list(words)


def test_a_run_that_cannot_be_written_is_evaluated_all_the_same(
    run_dir, use, monkeypatch
):
    whole = use("evaluate", run_dir)
    assert read_object(run_dir, EVALUATION) == json.loads(whole.out)
    (run_dir / EVALUATION).unlink()
    access = os.access
    monkeypatch.setattr(os, "access", lambda p, m: access(p, m) and not (m & os.W_OK))

    def fail(*args):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(run_dir_module, "write_object", fail)
    found = use("evaluate", run_dir)
    assert (found.code, found.out) == (0, whole.out)
    assert "cannot be written" in found.told.splitlines()[0]
