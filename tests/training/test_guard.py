"""What is not finite stops the run before it spreads, and can be repeated."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict

from flashdex import keys
from flashdex.errors import RunError
from flashdex.replay import disk
from flashdex.replay.codec import finite_rows
from flashdex.system.run_files import DUMP
from flashdex.system.tensors import first_non_finite, write_tensors
from flashdex.training import checkpoint
from flashdex.training.checkpoint import load_checkpoint
from flashdex.training.guard import (
    GradientGuard,
    NonFiniteError,
)
from flashdex.training.run_dir import reopen, resume

BAD = (float("nan"), float("inf"), -float("inf"))


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    ("key", "row", "kept"),
    [
        ("reward", 1, [0, 2, 3]),
        ("action", 2, [0, 1, 3]),
        ("state", 0, [1, 2, 3]),
        ("next_state", 1, [0, 2, 3]),
        ("next_state", 3, [0, 1, 2, 3]),  # terminated: nothing is bootstrapped there
    ],
)
def test_finite_rows(bad, key, row, kept):
    state = {"joint": torch.zeros(4, 2, 3), "frame": torch.zeros(4, 1).long()}
    rows = TensorDict(
        {
            "state": state,
            "next_state": copy.deepcopy(state),
            "action": torch.zeros(4, 2, 3),
            "reward": torch.zeros(4, 2),
            "terminated": torch.tensor([[False], [False], [False], [True]]),
        },
        [4],
    )
    value = rows[key, "joint"] if "state" in key else rows[key]
    value[row, -1] = bad
    assert finite_rows(rows).nonzero().flatten().tolist() == kept


@pytest.mark.parametrize("bad", BAD)
def test_the_first_bad_entry_is_named(bad):
    good = {
        "a": [torch.ones(2), 3, "x"],
        "b": {"c": 1.5, "flags": torch.ones(1).bool()},
    }
    assert first_non_finite(good) == ""
    good["nstep"] = torch.tensor([bad])  # raw simulator states may be anything
    assert first_non_finite(good) == ""
    good["b"]["c"] = bad
    assert first_non_finite(good) == "b.c"
    good["a"][0][1] = bad
    assert first_non_finite(good) == "a.0"


def two_optimisers():
    weights = [torch.nn.Parameter(torch.ones(3)) for _ in range(2)]
    return weights, [torch.optim.Adam([w], lr=0.1, fused=True) for w in weights]


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_gradient_raises_before_the_step(bad):
    (weight, _), (optimizer, _) = two_optimisers()
    weight.grad = torch.tensor([1.0, bad, 0.0])
    with GradientGuard(), pytest.raises(NonFiniteError, match=r"parameter 0, \(3,\)"):
        optimizer.step()
    assert weight.tolist() == [1, 1, 1]
    optimizer.step()  # the guard is gone with its block
    assert not weight.isfinite().all()


def test_without_waiting_a_bad_step_is_skipped_and_told_later():
    weights, optimizers = two_optimisers()
    weights[0].grad = torch.tensor([1.0, float("nan"), 0.0])
    weights[1].grad = torch.ones(3)
    with GradientGuard(waits=False) as guard:
        guard.check()
        for optimizer in optimizers:
            optimizer.step()
        weights[0].grad = torch.ones(3)
        optimizers[0].step()
        with pytest.raises(NonFiniteError):
            guard.check()
    # Adam's first step is the learning rate: one step each, the bad one left no trace
    assert weights[0].tolist() == pytest.approx([0.9] * 3)
    assert weights[1].tolist() == pytest.approx([0.9] * 3)


def step_of(bench, motion=0):
    """A vector step of a real environment: state, action, next state."""
    env = bench.make_env()
    td = env.reset()
    for side in keys.SIDES:
        td.set(keys.action(side), torch.zeros(env.num_envs, 18))
    td = env.step(td)
    return td, torch.zeros(env.num_envs, 2, 18), td["next"]


@pytest.mark.parametrize("bad", [*BAD, 1e6])
@pytest.mark.parametrize("where", ["reward", "state", "next", "terminal"])
def test_bad_steps_never_enter_the_buffer(make_bench, where, bad):
    if where == "reward" and bad == 1e6:
        pytest.skip("a large reward is a reward")
    learner = (bench := make_bench(4, algo={"n_step": 1})).make_learner(
        bench.make_env()
    )
    state, action, after = step_of(bench)
    reward = torch.ones(4, 2)
    flags = torch.zeros(4, 1, dtype=torch.bool)
    ended = flags.clone()
    if where == "reward":
        reward[2, 0] = reward[2, 1] = bad
    elif where == "state":
        state[keys.OBJECT_POSE][2, 0, 0] = bad
    else:
        after[keys.OBJECT_POSE][2, 0, 0] = bad
        ended[2] = where == "terminal"
    learner.process_step(state, action, reward, after, ended, ended)
    # Packing makes NaN zero; it cuts infinity to the largest float32, and half
    # precision does not reach that far.
    kept = 4 if where == "terminal" and bad != bad else 3
    assert learner.num_rows == 4
    assert learner.num_dropped == 4 - kept
    rows = learner.buffer.storage[torch.arange(4)]
    assert all(v.isfinite().all() for v in rows.values() if v.is_floating_point())
    is_copy = all(torch.equal(v[2], v[1]) for v in rows.values())
    assert is_copy == (kept == 3)
    normalizer = learner.agent.normalizer.state_dict()
    assert first_non_finite(normalizer) == ""


def test_an_update_repeats_bit_for_bit(make_bench, collect):
    bench = make_bench(6)
    env = bench.make_env()
    one = bench.make_learner(env)
    collect(env, one, 20)
    for _ in range(4):
        one.update()
    before = one.state_dict()
    first = one.update()
    two = bench.make_learner(env)
    two.load_state_dict(before)
    again = two.redo(one.last_update)
    assert all(torch.equal(first[k], again[k]) for k in first.keys(True, True))


def test_states_and_learners_share_no_memory(make_bench, collect):
    bench = make_bench(6)
    env = bench.make_env()
    one, two = bench.make_learner(env), bench.make_learner(env)
    collect(env, one, 20)
    one.update()
    held = one.state_dict()
    kept = copy.deepcopy(held)
    two.load_state_dict(held)
    batch = one.sample()[0]
    for _ in range(2):
        two.agent.update(batch)
    assert same(held, kept)
    now = one.state_dict()
    now["agent"]["stepper"]["generator"] = kept["agent"]["stepper"]["generator"]
    assert same(now, kept)


def same(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def poison_rows(run_dir):
    for path in (run_dir / "checkpoints/replay").glob("*.pt"):
        content = torch.load(path)
        content["rows"]["reward"][:] = float("nan")
        write_tensors(content, path.parent, path.name)
    return "batch entry 'next.left.reward'"


def poison_weights(run_dir):
    path = max((run_dir / "checkpoints").glob("*.pt"))
    state = torch.load(path)
    weights = state["learner"]["agent"]["stepper"]["loss"]
    name = next(k for k in weights if k.startswith("qvalue") and k.endswith("weight"))
    weights[name].view(-1)[0] = float("nan")
    write_tensors(state, path.parent, path.name)
    return "state entry 'agent.stepper.loss."


@pytest.mark.parametrize("poison", [poison_rows, poison_weights])
def test_a_run_stops_with_a_dump_that_repeats_the_failure(
    train_tiny, poison, monkeypatch
):
    # what comes from files is looked at when it is read: as if it came up later
    for module in (checkpoint, disk):
        monkeypatch.setattr(module, "first_non_finite", lambda state: "")
    run_dir = train_tiny(train={"checkpoint_replay": True})
    cause = poison(run_dir)
    files = {p: p.read_bytes() for p in (run_dir / "checkpoints").rglob("*.pt")}
    with pytest.raises(RunError, match="not finite after") as caught:
        resume(run_dir, ["total_env_steps=2000"])
    text = str(caught.value)
    for expected in (cause, DUMP, "checkpoints/0000", "--resume", "algo.lr="):
        assert expected in text
    assert {p: p.read_bytes() for p in (run_dir / "checkpoints").rglob("*.pt")} == files
    learner, repeat = reopen(run_dir / DUMP)
    assert (
        learner.updates
        >= load_checkpoint(run_dir)["learner"]["agent"]["stepper"]["updates"]
    )
    with pytest.raises(NonFiniteError):
        repeat()


def test_what_is_no_dump_is_refused(tmp_path):
    (tmp_path / DUMP).write_bytes(b"no dump")
    with pytest.raises(RunError, match="not a readable dump"):
        reopen(tmp_path / DUMP)
