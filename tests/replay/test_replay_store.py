"""Replay in host memory: whole rows, in time, and the same as on the device."""

from __future__ import annotations

import threading

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.flashsac import make_buffer
from flashdex.errors import FlashdexError
from flashdex.replay.buffer import RowBuffer, RowStorage
from flashdex.replay.disk import ReplayLog

CPU = torch.device("cpu")
SIZES = {"batch_size": 64, "device": CPU}


def numbered(first, count):
    """Rows whose every entry is a function of their number."""
    number = torch.arange(first, first + count)
    return TensorDict(
        {
            "number": number,
            "wide": (number % 2000).half()[:, None].expand(-1, 50).clone(),
            "bytes": (number % 251).to(torch.uint8)[:, None].expand(-1, 300).clone(),
        },
        [count],
    )


def assert_whole(rows):
    number = rows["number"][:, None]
    assert torch.equal(rows["wide"], (number % 2000).half().expand(-1, 50))
    assert torch.equal(rows["bytes"], (number % 251).to(torch.uint8).expand(-1, 300))


def make_host(capacity=1000, **options):
    generator = torch.Generator().manual_seed(3)
    return RowBuffer(capacity, generator=generator, on_host=True, **SIZES, **options)


@pytest.mark.parametrize("stages", [0, 1, 3])
@pytest.mark.parametrize("prefetch", [0, 2])
def test_rows_can_be_sampled_when_they_have_arrived(stages, prefetch):
    buffer = make_host(stages=stages, prefetch=prefetch)
    for step in range(8):
        buffer.push(numbered(10 * step, 10))
        assert buffer.num_rows == 10 * max(0, step + 1 - stages)
    found = torch.cat([buffer.draw(2)["number"] for _ in range(20)])
    # the first batches; those that threads gathered ahead may be older
    assert set(found.tolist()) == set(range(10 * (8 - stages)))
    buffer.flush()
    assert buffer.num_rows == 80
    assert buffer.storage[torch.arange(80)]["number"].tolist() == list(range(80))
    buffer.push(numbered(80, 10))
    buffer.empty()
    buffer.flush()
    assert buffer.num_rows == 0


@pytest.mark.parametrize("prefetch", [1, 3])
def test_no_row_is_torn_while_a_writer_runs_beside_the_sampler(prefetch):
    capacity, step = 700, 96  # the ring wraps inside a push
    buffer = make_host(capacity, stages=2, prefetch=prefetch)
    pushed = [0]
    for _ in range(10):
        buffer.push(numbered(pushed[0], step))
        pushed[0] += step
    end = threading.Event()

    def write():
        while not end.is_set():
            buffer.push(numbered(pushed[0], step))
            pushed[0] += step

    writer = threading.Thread(target=write)
    writer.start()
    try:
        newest = 0
        for _ in range(150):
            rows = buffer.draw(2)
            assert rows.batch_size == (128,)
            assert_whole(rows)
            newest = max(newest, int(rows["number"].max()))
    finally:
        end.set()
        writer.join()
    assert newest > 20 * step  # the writer did run
    assert newest < pushed[0]
    buffer.flush()
    kept = buffer.storage[torch.arange(capacity)]
    assert_whole(kept)
    expected = range(pushed[0] - capacity, pushed[0])
    assert sorted(kept["number"].tolist()) == list(expected)


def test_without_threads_every_store_draws_the_same():
    drawn = []
    for replay in ("auto", "device", "cpu"):
        config = AlgoConfig(replay=replay, prefetch=0, batch_size=8, buffer_size=100)
        generator = torch.Generator().manual_seed(1)
        buffer = make_buffer(config, device=CPU, generator=generator, seed=7)
        buffer.push(numbered(0, 60))
        rows = [buffer.draw(1 + i % 2) for i in range(4)]
        assert [len(r) for r in rows] == [8, 16, 8, 16]
        drawn.append(torch.cat([r["number"] for r in rows]).tolist())
    assert drawn[0] == drawn[1] == drawn[2]


@pytest.mark.parametrize(
    ("replay", "prefetch", "on_host", "shared"),
    [
        ("auto", 2, False, True),
        ("device", 2, False, True),
        ("cpu", 2, True, False),
        ("cpu", 0, True, True),
    ],
)
def test_what_a_recipe_gets(replay, prefetch, on_host, shared):
    config = AlgoConfig(replay=replay, prefetch=prefetch)
    generator = torch.Generator()
    buffer = make_buffer(config, device=CPU, generator=generator, seed=7)
    assert buffer.on_host == on_host
    assert buffer.prefetch == (prefetch if on_host else 0)
    # threads must not draw from the generator of the noise
    assert (buffer.generator is generator) == shared


def test_pinned_memory_needs_a_cuda_device():
    config = AlgoConfig(replay="pinned")
    with pytest.raises(FlashdexError, match=r"algo\.replay.*'cpu'.*algo\.replay=auto"):
        make_buffer(config, device=CPU, generator=torch.Generator(), seed=0)


def test_a_ring_beyond_the_memory_is_refused_with_its_size():
    buffer = RowBuffer(1 << 50, generator=torch.Generator(), **SIZES)
    width = 8 + 2 * 50 + 300
    size = rf"{1 << 50} rows of {width} bytes are {(width << 50) / 1e9:.1f} GB"
    with pytest.raises(FlashdexError, match=size):
        buffer.push(numbered(0, 4))


def test_gathered_rows_are_those_that_indexing_reads():
    storage = RowStorage(30)
    storage.set(slice(0, 20), numbered(0, 20))
    index = torch.tensor([3, 19, 0, 3])
    assert_whole(storage.get(index))
    assert storage.get(index)["number"].tolist() == index.tolist()
    assert storage.get(slice(2, 5))["number"].tolist() == [2, 3, 4]
    assert storage.get(7)["number"] == 7


@pytest.mark.parametrize("prefetch", [0, 2])
def test_rows_on_their_way_are_in_the_checkpoint(tmp_path, prefetch):
    one = make_host(stages=2, prefetch=prefetch)
    log = ReplayLog(tmp_path, one, meaning="m")
    for step in range(3):
        one.push(numbered(10 * step, 10))
    log.save(f"{1:012d}")
    one.push(numbered(30, 10))
    log.save(f"{2:012d}")
    two = make_host(stages=2, prefetch=prefetch)
    assert ReplayLog(tmp_path, two, meaning="m").load(f"{2:012d}")
    assert two.num_rows == one.num_rows == 40
    kept = two.storage[torch.arange(40)]
    assert kept["number"].tolist() == list(range(40))
    assert_whole(two.draw())


@pytest.mark.parametrize("capacity", [1, 7, 64])
def test_the_ring_holds_the_newest_rows_where_torchrl_would_put_them(capacity):
    ours = RowBuffer(capacity, generator=torch.Generator(), **SIZES)
    theirs = ReplayBuffer(storage=LazyTensorStorage(capacity))
    first = 0
    for count in (1, 3, 7, 1, min(capacity, 40)):
        for start in range(first, first + count, capacity):
            rows = numbered(start, min(capacity, first + count - start))
            theirs.extend(rows)
        ours.push(numbered(first, count))
        first += count
        index = torch.arange(len(theirs))
        assert len(ours) == len(theirs)
        assert ours.write_count == theirs.write_count
        assert torch.equal(ours.storage[index]["number"], theirs[:]["number"])
        assert_whole(ours.storage[index])
