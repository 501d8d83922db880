"""Checkpoints and replay files: whole or absent, bounded, and never unpickled."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
import subprocess

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from flashdex.algorithms.base import snapshot
from flashdex.errors import RunError
from flashdex.replay import disk as replay_file
from flashdex.replay.disk import ReplayLog
from flashdex.system.run_files import CHECKPOINTS as FOLDER
from flashdex.system.run_files import remove_temporaries
from flashdex.training.checkpoint import (
    checkpoint_names,
    load_checkpoint,
    save_checkpoint,
    set_aside_newer,
)

CAPACITY = 20


def save(folder, steps, *, replay=None, **more):
    state = {"env_steps": steps, **more}
    return save_checkpoint(folder, state, keep=3, replay=replay)


def make_buffer(capacity=CAPACITY):
    return ReplayBuffer(
        storage=LazyTensorStorage(capacity),
        batch_size=7,
        generator=torch.Generator().manual_seed(5),
    )


class Rows:
    """Writes rows 0, 1, 2, ... into a buffer."""

    def __init__(self, buffer):
        self.buffer, self.next = buffer, 0

    def add(self, count):
        number = torch.arange(self.next, self.next + count)
        rows = {"number": number, "wide": number[:, None].half().expand(-1, 3)}
        self.buffer.extend(TensorDict(rows, [count]))
        self.next += count


def open_log(folder, buffer, meaning="m", **more):
    return ReplayLog(folder, buffer, meaning=meaning, **more)


def content(buffer):
    return buffer.storage[torch.arange(len(buffer))]["number"].tolist()


def test_the_newest_stay_and_no_temporary_does(tmp_path):
    for steps in (5, 300, 20, 1000):
        save(tmp_path, steps)
    assert checkpoint_names(tmp_path) == {f"{s:012d}" for s in (20, 300, 1000)}
    assert load_checkpoint(tmp_path)["env_steps"] == 1000
    assert len(list((tmp_path / FOLDER).iterdir())) == 3


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_checkpoint_falls_back_to_the_one_before(tmp_path, caplog, share):
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    os.truncate(newest, int(share * newest.stat().st_size))
    assert load_checkpoint(tmp_path)["env_steps"] == 1
    assert newest.name in caplog.text
    set_aside_newer(tmp_path, 1)
    save(tmp_path, 3)
    assert sorted(p.name for p in (tmp_path / FOLDER).iterdir()) == [
        "000000000001.pt",
        "000000000002.unreadable",
        "000000000003.pt",
    ]


def test_no_readable_checkpoint_is_an_error_that_names_them(tmp_path):
    with pytest.raises(RunError, match="no checkpoint in"):
        load_checkpoint(tmp_path)
    save(tmp_path, 1).write_bytes(b"not a checkpoint")
    with pytest.raises(RunError, match=r"no checkpoint can be read \(000000000001\.pt"):
        load_checkpoint(tmp_path)


def test_a_checkpoint_of_another_version_is_refused_not_passed_over(tmp_path):
    save(tmp_path, 1)
    path = save(tmp_path, 2)
    torch.save({"env_steps": 2}, path)
    with pytest.raises(RunError, match="checkpoint format 0, this version reads 3"):
        load_checkpoint(tmp_path)


def test_a_checkpoint_that_lacks_something_is_refused_by_name(tmp_path):
    path = save(tmp_path, 1, learner={})
    needs = ("env_steps", "learner", "recipe", "wall_s")
    with pytest.raises(RunError, match=rf"{path.name}: .* lacks recipe, wall_s\."):
        load_checkpoint(tmp_path, needs)
    assert load_checkpoint(tmp_path, needs[:2])["learner"] == {}


def test_foreign_code_is_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    save(tmp_path, 1).write_bytes(pickle.dumps(Trap()))
    with pytest.raises(RunError):
        load_checkpoint(tmp_path)
    assert not (tmp_path / "sprung").exists()


def test_half_written_files_of_a_killed_run_are_removed(tmp_path):
    kept = save(tmp_path, 1)
    half = tmp_path / FOLDER / ".000000000002.pt.77.tmp"
    half.write_bytes(b"half")
    remove_temporaries(tmp_path)
    assert not half.exists()
    assert kept.exists()


def test_a_snapshot_shares_nothing_and_keeps_the_kinds():
    state = torch.nn.BatchNorm1d(2).state_dict()
    nested = {"a": [state, (1, 2.0, None)]}
    copied = snapshot(nested)
    state["running_mean"] += 1
    assert copied["a"][0]["running_mean"].tolist() == [0, 0]
    assert copied["a"][0]._metadata == state._metadata
    assert copied["a"][1] == (1, 2.0, None)


@pytest.mark.parametrize("counts", [[3], [5, 4], [20], [13, 9, 6], [19, 19, 19, 2]])
def test_a_restored_ring_holds_every_row_where_it_was(tmp_path, counts):
    rows = Rows(make_buffer())
    log = open_log(tmp_path, rows.buffer)
    for steps, count in enumerate(counts):
        rows.add(count)
        save(tmp_path, steps, replay=log)
    again = make_buffer()
    later = open_log(tmp_path, again)
    assert later.load(f"{len(counts) - 1:012d}")
    assert content(again) == content(rows.buffer)
    # and both go on alike: ring position, sampling, and the next checkpoint's rows
    rest = Rows(again)
    rest.next = rows.next
    for part in (rows, rest):
        part.add(8)
    assert content(again) == content(rows.buffer)
    assert torch.equal(again.sample()["number"], rows.buffer.sample()["number"])
    save(tmp_path, 99, replay=later)
    third = make_buffer()
    assert open_log(tmp_path, third).load(f"{99:012d}")
    assert content(third) == content(again)


def test_a_checkpoint_writes_the_new_rows_only_and_the_disk_is_bounded(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(replay_file, "PART_BYTES", 3 * 14)  # three rows a file
    rows = Rows(make_buffer())
    log = open_log(tmp_path, rows.buffer)
    numbers = []
    for steps in range(30):
        rows.add(5)
        before = set(log.folder.glob("*.pt"))
        save(tmp_path, steps, replay=log)
        fresh = set(log.folder.glob("*.pt")) - before
        assert len(fresh) == 2  # 3 + 2 rows
        files = [torch.load(f)["rows"] for f in log.folder.glob("*.pt")]
        numbers = sorted(n for f in files for n in f["number"].tolist())
        assert len(numbers) <= CAPACITY + (3 - 1) * 5 + 2  # ring, two intervals, a part
    assert numbers[-CAPACITY:] == sorted(content(rows.buffer))
    assert len(list(log.folder.glob("*.json"))) == 3


@pytest.mark.parametrize(("capacity", "expected"), [(8, 8), (CAPACITY, 20), (50, 20)])
def test_another_size_takes_the_newest_rows(tmp_path, capacity, expected):
    rows = Rows(make_buffer())
    rows.add(17)
    rows.add(10)
    save(tmp_path, 1, replay=open_log(tmp_path, rows.buffer))
    other = make_buffer(capacity)
    log = open_log(tmp_path, other)
    assert log.load(f"{1:012d}")
    assert sorted(content(other)) == list(range(27 - expected, 27))
    more = Rows(other)
    more.next = 27
    more.add(3)
    save(tmp_path, 2, replay=log)
    again = make_buffer(capacity)
    assert open_log(tmp_path, again).load(f"{2:012d}")
    assert content(again) == content(other)


def test_rows_of_another_meaning_or_damaged_ones_leave_the_buffer_empty(
    tmp_path, caplog
):
    rows = Rows(make_buffer())
    log = open_log(tmp_path, rows.buffer)
    for steps in (1, 2):
        rows.add(6)
        save(tmp_path, steps, replay=log)
    other = make_buffer()
    assert not open_log(tmp_path, other, meaning="other").load(f"{2:012d}")
    assert "override" in caplog.text
    newest = log.folder / f"{2:012d}-0.pt"
    os.truncate(newest, newest.stat().st_size // 2)
    damaged = open_log(tmp_path, other)
    assert not damaged.load(f"{2:012d}")
    assert len(other) == 0
    Rows(other).add(4)
    save(tmp_path, 3, replay=damaged)
    third = make_buffer()
    assert open_log(tmp_path, third).load(f"{3:012d}")
    assert content(third) == [0, 1, 2, 3]


def test_a_crash_between_rows_and_checkpoint_leaves_the_former_pair(tmp_path):
    rows = Rows(make_buffer())
    log = open_log(tmp_path, rows.buffer)
    rows.add(6)
    save(tmp_path, 1, replay=log)
    rows.add(16)  # overwrites rows 0 and 1 in the ring
    log.save(f"{2:012d}")  # killed here: no checkpoint 2
    again = make_buffer()
    resumed = open_log(tmp_path, again)
    resumed.prune(checkpoint_names(tmp_path))
    assert not (log.folder / f"{2:012d}.json").exists()
    assert resumed.load(f"{1:012d}")
    assert content(again) == [0, 1, 2, 3, 4, 5]


def test_switched_off_nothing_is_stored_and_old_rows_go(tmp_path):
    rows = Rows(make_buffer())
    rows.add(6)
    save(tmp_path, 1, replay=open_log(tmp_path, rows.buffer))
    off = open_log(tmp_path, rows.buffer, enabled=False)
    for steps in (2, 3, 4):
        save(tmp_path, steps, replay=off)
    assert list(off.folder.iterdir()) == []


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root to mount a small file system")
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("this system mounts no tmpfs")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("fills", ["state", "rows"])
def test_a_full_disk_costs_one_checkpoint(small_disk, fills):
    rows = Rows(make_buffer(5000))
    log = open_log(small_disk, rows.buffer)
    rows.add(10)
    state = {"env_steps": 1, "weights": torch.arange(1000.0)}
    save_checkpoint(small_disk, state, keep=3, replay=log)
    big = copy.deepcopy(state)
    big["env_steps"] = 2
    if fills == "state":
        rows.add(10)
        big["weights"] = torch.zeros(100_000)
    else:
        rows.add(4900)
        blocker = small_disk / "something"
        blocker.write_bytes(bytes(180_000))
    with pytest.raises(OSError, match=r"."):
        save_checkpoint(small_disk, big, keep=3, replay=log)
    assert torch.equal(load_checkpoint(small_disk)["weights"], state["weights"])
    assert list(small_disk.rglob(".*.tmp")) == []
    # with room again the next one holds all rows, also those of the failed one
    if fills == "rows":
        blocker.unlink()
    rows.add(10)
    save_checkpoint(small_disk, {**state, "env_steps": 3}, keep=3, replay=log)
    again = make_buffer(5000)
    assert open_log(small_disk, again).load(f"{3:012d}")
    assert content(again) == content(rows.buffer)
