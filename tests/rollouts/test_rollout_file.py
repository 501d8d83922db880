"""Stored rollouts: round trip, atomic write and the faults of broken files."""

import os
from dataclasses import fields

import numpy as np
import pytest

from flashdex.errors import RunError
from flashdex.rollouts.rollout import Rollout


@pytest.fixture
def stored(rollout, tmp_path):
    return rollout.save(tmp_path / "rollouts" / "push.npz")


def rewrite(path, **changes):
    """The same file with keys replaced, or removed when None."""
    with np.load(path) as file:
        data = {k: file[k] for k in file.files} | changes
    np.savez(path, **{k: v for k, v in data.items() if v is not None})


def test_round_trip_keeps_every_value(rollout, stored):
    again = Rollout.load(stored)
    for field in fields(Rollout):
        old, new = getattr(rollout, field.name), getattr(again, field.name)
        if isinstance(old, np.ndarray):
            np.testing.assert_array_equal(new, old)
            assert new.dtype == old.dtype
        else:
            assert new == old
            assert type(new) is type(old)


def test_optional_arrays_survive(build_rollout, tmp_path):
    wrist = np.random.default_rng(0).normal(size=(90, 2, 3))
    rollout = build_rollout(wrist_pos=wrist, ref_wrist_pos=wrist, num_ref_frames=91)
    again = Rollout.load(rollout.save(tmp_path / "a.npz"))
    np.testing.assert_array_equal(again.wrist_pos, wrist)
    assert again.reference_length == 91
    assert again.score()["chord_sr"].state == "passed"


def test_stored_states_are_scored_without_the_library(stored):
    scores = Rollout.load(stored).score()
    assert scores["sr_mt"].state == "passed"
    assert scores["sr_mt"].values["joint"] == 0.0
    assert scores["sr_mt_right"].reason == "hand_absent"


def test_no_pickle_is_inside(stored):
    with np.load(stored, allow_pickle=False) as file:
        assert all(file[key].dtype != object for key in file.files)


@pytest.mark.parametrize("key", ["ctrl", "model_xml", "ref_object_quat", "hand_active"])
def test_missing_key_is_named(stored, key):
    rewrite(stored, **{key: None})
    with pytest.raises(RunError, match=rf"missing keys {key}\."):
        Rollout.load(stored)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fingertips", np.zeros((90, 2, 4, 3))),
        ("qpos", np.zeros((89, 8))),
        ("qvel0", np.zeros(6)),
        ("object_quat", np.zeros((90, 2, 4))),
        ("hand_object", np.zeros(1, dtype=int)),
        ("object_qpos_adr", np.zeros(2, dtype=int)),
    ],
)
def test_wrong_shape_is_named_with_file_and_expectation(stored, key, value):
    rewrite(stored, **{key: value})
    with pytest.raises(RunError, match=r"push\.npz: .* has shape .*expected \("):
        Rollout.load(stored)


def test_other_schema_is_refused(stored):
    rewrite(stored, schema=np.asarray(99))
    with pytest.raises(RunError, match="schema 99, this version reads 1"):
        Rollout.load(stored)


def test_foreign_npz_is_refused(stored):
    rewrite(stored, schema=None)
    with pytest.raises(RunError, match="missing key schema"):
        Rollout.load(stored)


def test_changed_model_is_noticed(stored, scene_xml):
    rewrite(stored, model_xml=np.asarray(scene_xml.replace('mass=".3"', 'mass=".1"')))
    with pytest.raises(RunError, match="model_sha256 does not match"):
        Rollout.load(stored)


def test_broken_json_is_named(stored):
    rewrite(stored, versions=np.asarray("{"))
    with pytest.raises(RunError, match="versions is not JSON"):
        Rollout.load(stored)


def test_hand_on_an_absent_slot_is_refused(stored):
    rewrite(stored, hand_object=np.array([1, -1]))
    with pytest.raises(RunError, match="beyond the 1 objects"):
        Rollout.load(stored)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 half"])
def test_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    with pytest.raises(RunError, match="not a readable rollout"):
        Rollout.load(path)


def test_truncated_file_is_refused(stored):
    stored.write_bytes(stored.read_bytes()[:2000])
    with pytest.raises(RunError, match="not a readable rollout"):
        Rollout.load(stored)


def test_pickled_arrays_are_refused(stored):
    rewrite(stored, motion=np.array([{"a": 1}], dtype=object))
    with pytest.raises(RunError, match="without pickled objects"):
        Rollout.load(stored)


def test_absent_file_is_refused(tmp_path):
    with pytest.raises(RunError, match="no such file"):
        Rollout.load(tmp_path / "none.npz")


def test_failed_write_leaves_the_old_file(rollout, stored, monkeypatch):
    before = stored.read_bytes()

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    rollout.seed = 4
    with pytest.raises(OSError, match="disk full"):
        rollout.save(stored)
    assert stored.read_bytes() == before
    assert [p.name for p in stored.parent.iterdir()] == ["push.npz"]
