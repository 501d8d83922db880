"""Work beside a block: order, errors, and a learner that cannot tell."""

from __future__ import annotations

import threading
import time

import pytest
import torch

from flashdex.envs.tracking import few_threads
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.trainer import BackgroundWorker


@pytest.mark.parametrize("threaded", [True, False])
def test_work_has_ended_when_the_block_is_left(threaded):
    done = []
    worker = BackgroundWorker(threaded=threaded)
    with worker.run(lambda: done.append(threading.current_thread().name)):
        pass
    worker.close()
    assert len(done) == 1
    assert done[0].startswith("learner") == threaded


def test_both_run_at_the_same_time():
    meet = threading.Barrier(2, timeout=20)  # breaks unless both sides come
    with BackgroundWorker(threaded=True).run(meet.wait):
        meet.wait()
    assert not meet.broken


def test_the_work_keeps_its_torch_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    found = []

    def work():
        lowered.wait(20)
        torch.rand(512, 512) @ torch.rand(512, 512)
        found.append(torch.get_num_threads())

    lowered = threading.Event()
    try:
        worker = BackgroundWorker(threaded=True)
        with worker.run(work), few_threads(1):
            lowered.set()
            while not found:
                time.sleep(0.001)
            assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
    assert found == [3]


@pytest.mark.parametrize("threaded", [True, False])
def test_an_error_of_the_work_comes_out(threaded):
    def work():
        raise ArithmeticError("inside")

    with (
        pytest.raises(ArithmeticError, match="inside"),
        BackgroundWorker(threaded=threaded).run(work),
    ):
        pass


def test_an_error_of_the_block_is_shown_first():
    def work():
        raise ArithmeticError("inside")

    with pytest.raises(KeyError), BackgroundWorker(threaded=True).run(work):
        raise KeyError


def leaves(state):
    if isinstance(state, dict):
        return [x for v in state.values() for x in leaves(v)]
    if isinstance(state, list | tuple):
        return [x for v in state for x in leaves(v)]
    return [state]


def test_a_run_cannot_tell_whether_it_learnt_beside_the_physics(start_tiny, tmp_path):
    states = []
    for overlap in (True, False):
        folder = tmp_path / str(overlap)
        start_tiny(folder, train={"overlap": overlap})
        states.append(leaves(load_checkpoint(folder)["learner"]))
    one, two = states
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
        assert same
