"""The ledger: one line an attempt, conversions that survive a crash."""

from __future__ import annotations

import copy
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import tamper
import torch

from flashdex.errors import FlashdexError, RunError
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.ledger import CONVERSIONS, UNMOVED, Ledger
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.verify import verify_run
from flashdex.system.arrays import hash_content
from flashdex.system.jsonl import append_line, read_lines, write_lines
from flashdex.system.run_files import miss_name, rollout_name
from flashdex.training.loaded import open_truth

REQUIRED = {
    "motion": str,
    "converted": bool,
    "criterion": str,
    "errors": dict,
    "env_steps": int,
    "wall_s": float,
    "seed": int,
    "engine": str,
    "completed": bool,
    "why": list,
    "frame": int,
}


@pytest.fixture(scope="module")
def attempts(roll_tiny):
    """Zero residual actions: three attempts of full length."""

    def idle(td, env):
        return torch.zeros(env.num_envs, 2, 18)

    return roll_tiny(idle)


@pytest.fixture
def passing(attempts):
    """An attempt whose objects are written onto the reference, so that it passes."""
    rollout = copy.deepcopy(attempts[0])
    rollout.object_pos = rollout.ref_object_pos.copy()
    rollout.object_quat = rollout.ref_object_quat.copy()
    return rollout


@pytest.fixture
def failing(attempts):
    """An attempt whose object is half a metre off from frame 20 on."""
    rollout = copy.deepcopy(attempts[1])
    rollout.object_pos = rollout.ref_object_pos.copy()
    rollout.object_pos[20:, :, 0] += 0.5
    return rollout


def open_ledger(folder, library, **changes):
    settings = {"criterion": "sr_mt_obj", "seed": 3, "engine": "cpu", "certify": False}
    return Ledger(folder, library.names, **{**settings, **changes})


def record(ledger, rollout, *, env_steps, wall_s):
    """Record a rollout as one made at these env steps; is it the first pass?"""
    rollout.env_steps = env_steps
    line, is_first = ledger.record(rollout, wall_s=wall_s)
    assert line == read_lines(ledger.path)[-1]
    return is_first


def test_one_json_line_an_attempt(tmp_path, library, attempts, failing):
    ledger = open_ledger(tmp_path, library)
    for i, attempt in enumerate([*attempts, failing]):
        record(ledger, attempt, env_steps=100 * i, wall_s=1.5 * i)
    lines = [json.loads(x) for x in (tmp_path / CONVERSIONS).read_text().splitlines()]
    assert len(lines) == 4
    for line in lines:
        for key, kind in REQUIRED.items():
            assert isinstance(line[key], kind), key
        assert line["certified"] is None
        assert set(line["errors"]) == {"object_pos", "object_rot"}
        assert (line["criterion"], line["seed"]) == ("sr_mt_obj", 3)
    assert [x["env_steps"] for x in lines] == [0, 100, 200, 300]
    assert ledger.attempts == {"right_box": 1, "left_ball": 2, "both": 1}


def test_a_failed_attempt_says_why(tmp_path, library, failing):
    ledger = open_ledger(tmp_path, library)
    assert not record(ledger, failing, env_steps=5, wall_s=0.1)
    line = read_lines(tmp_path / CONVERSIONS)[0]
    assert not line["converted"]
    cause = line["why"][0]
    assert (cause["cause"], cause["hand"], cause["frame"]) == ("object_pos", "left", 20)
    errors = failing.object_pos[15:, 0] - failing.ref_object_pos[15:, 0]
    mean = np.linalg.norm(errors, axis=-1).mean()
    assert line["errors"]["object_pos"] == pytest.approx(mean, abs=1e-5)
    assert not list((tmp_path / "rollouts").iterdir())


def test_an_attempt_that_was_ended_names_the_termination(tmp_path, library, failing):
    failing.terminations = [{"cause": "object_dropped", "hand": "left"}]
    ledger = open_ledger(tmp_path, library)
    record(ledger, failing, env_steps=5, wall_s=0.1)
    line = read_lines(tmp_path / CONVERSIONS)[0]
    assert line["why"] == [{"cause": "object_dropped", "hand": "left"}]
    assert line["completed"] is False


def test_only_the_first_pass_is_a_conversion(tmp_path, library, passing):
    ledger = open_ledger(tmp_path, library)
    assert record(ledger, passing, env_steps=10, wall_s=2.0)
    first = ledger.conversions["right_box"]
    assert (first["env_steps"], first["certified"]) == (10, None)
    assert not record(ledger, passing, env_steps=20, wall_s=3.0)
    assert ledger.num_converted == 1
    lines = read_lines(tmp_path / CONVERSIONS)
    assert [x["converted"] for x in lines] == [True, True]
    stored = Rollout.load(tmp_path / lines[0]["rollout"])
    assert (stored.qpos == passing.qpos).all()
    assert json.loads(stored.errors) == lines[0]["errors"]
    metrics = ledger.metrics(2.0)
    assert metrics["convert/cumulative"] == 1
    assert metrics["convert/rate"] == pytest.approx(1 / 3)
    assert metrics["convert/attempts"] == 2
    assert metrics["convert/per_hour"] == 0.5


def test_the_stored_verdict_is_that_of_a_fresh_certificate(tmp_path, library, passing):
    ledger = open_ledger(tmp_path, library, certify=True)
    assert record(ledger, passing, env_steps=10, wall_s=2.0)
    conversion = ledger.conversions["right_box"]
    line = read_lines(tmp_path / CONVERSIONS)[0]
    fresh = certify(Rollout.load(tmp_path / line["rollout"]))
    assert line["verdict"] == fresh.verdict
    assert line["certified"] == conversion["certified"]
    assert line["certified"] == (fresh.verdict in ("certified", "robust"))
    stored = json.loads((tmp_path / "rollouts/right_box.certificate.json").read_text())
    assert stored == json.loads(fresh.to_json())
    assert ledger.num_certified == int(line["certified"])


@pytest.mark.parametrize("cut", [1, 40])
def test_a_cut_off_last_line_costs_that_line_only(
    tmp_path, library, passing, failing, cut
):
    ledger = open_ledger(tmp_path, library)
    record(ledger, passing, env_steps=10, wall_s=2.0)
    record(ledger, failing, env_steps=20, wall_s=2.5)
    path = tmp_path / CONVERSIONS
    path.write_text(path.read_text()[:-cut])
    again = open_ledger(tmp_path, library)
    assert list(again.conversions) == ["right_box"]
    assert again.conversions["right_box"]["env_steps"] == 10
    assert again.attempts["right_box"] == 1
    # what is written next must be readable, too
    record(again, failing, env_steps=30, wall_s=3.0)
    lines = read_lines(path)
    assert lines[-1]["env_steps"] == 30
    assert open_ledger(tmp_path, library).attempts["left_ball"] == 1
    assert list(open_ledger(tmp_path, library).conversions) == ["right_box"]


def test_a_broken_line_in_the_middle_is_an_error(tmp_path):
    path = tmp_path / "x.jsonl"
    write_lines(path, [{"a": 1}])
    path.write_text(path.read_text() + '{"b":\n{"c": 2}\n')
    with pytest.raises(RunError, match="line 2 has no seal"):
        read_lines(path)


def test_lines_of_another_criterion_or_motion_do_not_count(tmp_path, library, passing):
    record(open_ledger(tmp_path, library), passing, env_steps=10, wall_s=2.0)
    strict = open_ledger(tmp_path, library, criterion="sr_mt_obj_x0.5")
    assert strict.num_converted == 0
    lines = read_lines(tmp_path / CONVERSIONS)
    write_lines(tmp_path / CONVERSIONS, [x | {"motion": "left_out"} for x in lines])
    assert open_ledger(tmp_path, library).num_converted == 0


def test_a_later_pass_may_prove_what_the_first_could_not(tmp_path, library, passing):
    unproven = copy.deepcopy(passing)  # its objects are moved: the certificate fails
    ledger = open_ledger(tmp_path, library, certify=True)
    assert record(ledger, unproven, env_steps=10, wall_s=2.0)
    first = ledger.conversions[unproven.motion]
    assert not first["certified"]
    assert not record(ledger, unproven, env_steps=20, wall_s=3.0)
    lines = read_lines(tmp_path / CONVERSIONS)
    assert [bool(x.get("rollout")) for x in lines] == [True, True]
    assert first["env_steps"] == 10
    assert ledger.metrics(1.0)["convert/robust"] == 0


def test_what_is_trivial_is_counted_apart(tmp_path, library, passing):
    ledger = open_ledger(tmp_path, library, trivial={"right_box": ["do_nothing"]})
    record(ledger, passing, env_steps=10, wall_s=2.0)
    assert (ledger.num_converted, ledger.num_trivial, ledger.num_passed) == (0, 1, 1)
    assert ledger.note == "0 of 3 converted, and 1 trivial"
    found = ledger.metrics(1.0)
    assert next(iter(found)) == "convert/nontrivial"
    assert (found["convert/nontrivial"], found["convert/trivial"]) == (0, 1)
    assert found["convert/cumulative"] == 1


def test_an_object_that_hardly_moves_is_trivial_until_it_moves(
    tmp_path, library, passing
):
    still = copy.deepcopy(passing)
    still.object_pos[:] = still.object_pos[:1]
    ledger = open_ledger(tmp_path, library)
    assert not record(ledger, still, env_steps=10, wall_s=2.0)
    line = read_lines(tmp_path / CONVERSIONS)[-1]
    assert line["trivial"] == [UNMOVED]
    assert (line["lift_ratio"], line["path_ratio"]) == (0.0, 0.0)
    assert ledger.note == "0 of 3 converted, and 1 trivial"
    assert not ledger.done  # the run goes on
    assert record(ledger, passing, env_steps=20, wall_s=3.0)
    assert ledger.done == ["right_box"]
    assert ledger.note == "1 of 3 converted, 0 certified"
    assert ledger.conversions["right_box"]["env_steps"] == 20
    # a later one that hardly moves takes nothing back, nor does a new session
    record(ledger, still, env_steps=30, wall_s=4.0)
    stored = Rollout.load(tmp_path / rollout_name("right_box"))
    assert (stored.object_pos == passing.object_pos).all()
    for again in (ledger, open_ledger(tmp_path, library)):
        assert (again.num_converted, again.num_trivial) == (1, 0)


def test_a_proof_without_movement_proves_no_movement(
    tmp_path, library, passing, monkeypatch
):
    made = SimpleNamespace(
        save=lambda path: path.write_text("{}"), verdict="failed", survived=0.0
    )
    monkeypatch.setattr("flashdex.rollouts.ledger.certify", lambda *_, **__: made)
    still = copy.deepcopy(passing)
    still.object_pos[:] = still.object_pos[:1]
    ledger = open_ledger(tmp_path, library, certify=True)
    record(ledger, passing, env_steps=10, wall_s=2.0)
    made.verdict = "robust"
    record(ledger, still, env_steps=20, wall_s=3.0)
    assert "rollout" not in read_lines(tmp_path / CONVERSIONS)[-1]
    assert ledger.note == "1 of 3 converted, 0 certified"


def off_by(rollout, metres):
    """The attempt with its objects that far off all the time, and moving with it."""
    found = copy.deepcopy(rollout)
    found.object_pos = rollout.ref_object_pos + np.array([metres, 0.0, 0.0])
    found.object_quat = rollout.ref_object_quat.copy()
    return found


def test_the_nearest_miss_is_stored_until_the_motion_converts(
    tmp_path, library, attempts, passing
):
    ledger, miss = open_ledger(tmp_path, library), tmp_path / miss_name("right_box")
    stored = []
    for i, metres in enumerate([0.5, 0.49, 0.4, 0.45, 0.1]):
        line, _ = ledger.record(off_by(attempts[0], metres), wall_s=1.0 + i)
        stored.append("miss" in line)
        assert line.get("miss", "misses/right_box.npz") == "misses/right_box.npz"
        if "miss" in line:
            assert line["miss_sha256"] == hash_content(miss)
    assert stored == [True, False, True, False, True]
    kept = Rollout.load(miss)
    assert json.loads(kept.errors)["object_pos"] == pytest.approx(0.1)
    assert ledger.num_passed == 0
    again = open_ledger(tmp_path, library)
    assert "miss" not in again.record(off_by(attempts[0], 0.3), wall_s=8.0)[0]
    assert record(again, passing, env_steps=10, wall_s=9.0)
    assert not miss.exists()
    assert "miss" not in again.record(off_by(attempts[0], 0.04), wall_s=9.5)[0]
    assert not miss.exists()


def test_a_miss_that_is_lost_or_changed_gives_way_to_the_next(
    tmp_path, library, attempts
):
    ledger, miss = open_ledger(tmp_path, library), tmp_path / miss_name("right_box")
    ledger.record(off_by(attempts[0], 0.1), wall_s=1.0)
    for spoil in (miss.unlink, lambda: miss.write_bytes(b"hello")):
        spoil()
        again = open_ledger(tmp_path, library)
        again.adopt(wall_s=2.0)
        assert "miss" in again.record(off_by(attempts[0], 0.5), wall_s=2.0)[0]


@pytest.mark.parametrize("name", ["../evil", "/evil", "", "a\0b", "a\nb", "x" * 300, 7])
def test_a_name_that_is_none_makes_no_file(tmp_path, name):
    with pytest.raises(FlashdexError, match="no name of a motion"):
        Ledger(tmp_path / "run", [name], criterion="sr_mt_obj", seed=0, engine="cpu")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["päck aus", "a b", "CON", "-x"])
def test_any_name_has_files_of_plain_names(tmp_path, passing, name):
    passing.motion = name
    ledger = Ledger(
        tmp_path, [name], criterion="sr_mt_obj", seed=0, engine="cpu", certify=False
    )
    line, _ = ledger.record(passing, wall_s=1.0)
    assert line["rollout"] == rollout_name(name)
    assert (tmp_path / line["rollout"]).is_file()
    assert line["rollout"].isascii()
    assert Rollout.load(tmp_path / line["rollout"]).motion == name


LINKS = {
    "ledger": CONVERSIONS,
    "rollout": "rollouts/right_box.npz",
    "folder": "rollouts",
}


@pytest.mark.parametrize("place", LINKS)
def test_a_link_is_not_written_through(tmp_path, library, passing, place):
    run, other = tmp_path / "run", tmp_path / "other"
    (run / "rollouts").mkdir(parents=True)
    if place == "folder":
        (run / "rollouts").rmdir()
        other.mkdir()
    else:
        other.write_bytes(b"precious")
    (run / LINKS[place]).symlink_to(other)
    with pytest.raises(RunError, match="is a link"):
        record(open_ledger(run, library), passing, env_steps=1, wall_s=1.0)
    assert list(other.iterdir()) == [] if other.is_dir() else True
    assert other.is_dir() or other.read_bytes() == b"precious"


@pytest.fixture
def orphan(converted_run, tmp_path):
    """A stored rollout whose line a crash has cost, and its ledger opened again."""
    run = tmp_path / "run"
    shutil.copytree(converted_run, run)
    (run / CONVERSIONS).unlink()

    def reopen():
        return Ledger(run, ["right_box"], criterion="sr_mt_obj", seed=0, engine="cpu")

    return run, reopen


def test_a_rollout_without_its_line_gets_one_and_holds(orphan, truth):
    run, reopen = orphan
    assert reopen().adopt(wall_s=9.0) == ["right_box"]
    assert reopen().adopt(wall_s=9.0) == []
    (line,) = read_lines(run / CONVERSIONS)
    assert (line["wall_s"], line["verdict"]) == (9.0, "robust")
    assert verify_run(run, truth).rollouts[0].holds


@pytest.fixture(scope="module")
def missed_run(start_tiny, tmp_path_factory):
    """A finished run with a nearest miss: nobody passes by such a criterion."""
    folder = tmp_path_factory.mktemp("missed") / "run"
    train = {"criterion": "sr_mt_obj_moved"}
    return start_tiny(folder, train=train, select=["right_box"])


def test_a_miss_without_its_line_gets_one(missed_run, tmp_path):
    run = shutil.copytree(missed_run, tmp_path / "run")
    lines = read_lines(run / CONVERSIONS)
    (*_, last) = (i for i, line in enumerate(lines) if line.get("miss"))
    write_lines(run / CONVERSIONS, lines[:last])

    def reopen():
        return Ledger(
            run, ["right_box"], criterion="sr_mt_obj_moved", seed=0, engine="cpu"
        )

    assert reopen().adopt(wall_s=9.0) == ["right_box"]
    assert reopen().adopt(wall_s=9.0) == []
    *before, told = read_lines(run / CONVERSIONS)
    assert before == lines[:last]
    assert told["miss_sha256"] == hash_content(run / miss_name("right_box"))
    unknown = {"wall_s": 0, "completed": 0, "why": 0, "miss_sha256": 0}  # not in it
    assert told | unknown == lines[last] | unknown
    assert reopen().num_passed == 0


MISSED = {
    "flipped": (lambda path: path.write_bytes(path.read_bytes()[:-9]), "file:"),
    "gone": (lambda path: path.unlink(), "is missing"),
    "its actions": (
        lambda path: tamper_with(path, actions=tamper.load(path)["actions"] * 0.9),
        "ctrl: is up to",
    ),
    "another name": (
        lambda path: path.rename(path.with_name("left_ball.npz")),
        "is that of 'right_box'",
    ),
}


@pytest.mark.parametrize("damage", MISSED)
def test_a_miss_that_is_not_as_it_was_stored_is_found(missed_run, tmp_path, damage):
    run, (spoil, told) = shutil.copytree(missed_run, tmp_path / "run"), MISSED[damage]
    truth, _ = open_truth(run)
    verified = verify_run(run, truth)
    assert verified.holds
    assert list(verified.misses) == ["misses/right_box.npz"]
    assert verified.rollouts == []
    spoil(run / miss_name("right_box"))
    found = [str(f) for f in verify_run(run, truth).findings if f.is_fault]
    assert any(told in text for text in found), found
    is_changed = damage in ("its actions",)
    assert not is_changed or any("miss_sha256" in text for text in found)


def test_a_better_plan_whose_line_a_crash_has_cost_gets_one(orphan, converted_run):
    """The one before it is gone; the run says so once, and names the file there is."""
    run, reopen = orphan
    lines = read_lines(converted_run / CONVERSIONS)
    (line,) = [x for x in lines if x.get("rollout") and x["motion"] == "right_box"]
    before = {"rollout_sha256": "0" * 64, "verdict": "certified", "survived": 0.5}
    append_line(run / CONVERSIONS, line | before | {"env_steps": 0})
    assert reopen().adopt(wall_s=9.0) == ["right_box"]
    assert reopen().adopt(wall_s=9.0) == []
    _, last = read_lines(run / CONVERSIONS)
    assert last["rollout_sha256"] == line["rollout_sha256"]
    assert last["verdict"] == "robust"
    told = reopen().conversions["right_box"]
    assert told["rollout_sha256"] == line["rollout_sha256"]
    assert (told["env_steps"], told["survived"]) == (0, last["survived"])


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "flipped": lambda path: path.write_bytes(
        path.read_bytes()[:5000] + b"?" + path.read_bytes()[5001:]
    ),
    "something else": lambda path: path.write_text("hello"),
    "of another motion": lambda path: tamper_with(path, motion="left_ball"),
    "reference is the result": lambda path: tamper_with(
        path, object_pos=tamper.load(path)["ref_object_pos"]
    ),
    "assisted": lambda path: tamper_with(
        path, wrench=tamper.load(path)["wrench"] + 1.0
    ),
}


def tamper_with(path, **changes):
    data = tamper.load(path)
    tamper.store(path, data | {k: np.asarray(v) for k, v in changes.items()})


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_rollout_is_told_and_not_adopted(orphan, caplog, kind):
    run, reopen = orphan
    path = run / "rollouts" / "right_box.npz"
    DAMAGES[kind](path)
    before = path.read_bytes()
    assert reopen().adopt(wall_s=9.0) == []
    assert "left as it is" in caplog.text
    assert path.read_bytes() == before
    assert read_lines(run / CONVERSIONS) == []


def test_a_rollout_changed_after_its_line_is_not_adopted(orphan, caplog):
    run, reopen = orphan
    reopen().adopt(wall_s=9.0)
    path = run / "rollouts" / "right_box.npz"
    tamper_with(path, seed=5)
    assert reopen().adopt(wall_s=10.0) == []
    assert "changed after its line was written" in caplog.text


FOREIGN = {
    "NUL tail": (b"\0" * 50, True),
    "cut off": (b'{"motion": "right', True),
    "blank": (b"\n", False),
    "garbage": (b"garbage\n", False),
    "list": (b"[1]\n", False),
    "latin-1": ('{"motion": "p\u00e4ck"}\n'.encode("latin-1"), False),
    "BOM": (b"\xef\xbb\xbf{}\n", False),
    "without its keys": (b'{"motion": "right_box"}\n', False),
    "another kind": (
        b'{"motion": 3, "converted": true, "criterion": "sr_mt_obj", "errors": {}, '
        b'"env_steps": 1, "wall_s": 1.0}\n',
        False,
    ),
    "deep": (b"[" * 100_000 + b"\n", False),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_line_is_refused_and_a_torn_one_removed(
    tmp_path, library, passing, kind
):
    tail, is_torn = FOREIGN[kind]
    record(open_ledger(tmp_path, library), passing, env_steps=10, wall_s=2.0)
    path = tmp_path / CONVERSIONS
    lines = read_lines(path)
    path.write_bytes(path.read_bytes() + tail)
    if is_torn:
        assert open_ledger(tmp_path, library).num_passed == 1
        assert read_lines(path) == lines
    else:
        with pytest.raises(RunError, match="line 2"):
            open_ledger(tmp_path, library)


def test_a_line_that_names_another_file_is_not_followed(tmp_path, library, passing):
    record(open_ledger(tmp_path, library), passing, env_steps=10, wall_s=2.0)
    (line,) = read_lines(tmp_path / CONVERSIONS)
    evil = line | {"rollout": "../../evil.npz", "env_steps": 20}
    append_line(tmp_path / CONVERSIONS, evil)
    found = verify_run(tmp_path)
    assert any("not the rollout of its motion" in str(f) for f in found.findings)
