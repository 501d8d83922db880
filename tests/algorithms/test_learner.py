"""The learner on the environment, with tiny networks."""

from __future__ import annotations

import pytest
import torch

from flashdex import keys
from flashdex.envs.transforms.assembly import assemble
from flashdex.training.checkpoint import load_checkpoint, save_checkpoint

GROUPS = ("per_hand", "unified")


def parameters(learner):
    return {k: v.clone() for k, v in learner.agent.loss.state_dict().items()}


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("future", [True, False])
def test_act_remember_update(make_bench, collect, groups, future):
    env = {} if future else {"transforms": {"proprioception": {}, "object_state": {}}}
    bench = make_bench(6, algo={"groups": groups}, **env)
    env = bench.make_env()
    learner = bench.make_learner(env)
    assert not learner.ready
    collect(env, learner, 20)
    assert learner.ready
    assert len(learner.buffer) == 6 * (20 - 2)
    before = parameters(learner)
    metrics = [learner.update() for _ in range(3)]
    names = ("left", "right") if groups == "per_hand" else ("both",)
    for record in metrics:
        assert {k[0] for k in record.keys(True, True) if isinstance(k, tuple)} == set(
            names
        )
        assert all(torch.isfinite(v).all() for v in record.values(True, True))
    after = learner.agent.loss.state_dict()
    changed = {k.split(".")[0] for k in before if not torch.equal(before[k], after[k])}
    assert {"actor_network", "qvalue_network", "target_qvalue_network"} <= changed
    assert learner.updates == 3


def test_sample_is_what_the_policy_saw(make_bench, collect, bank):
    bench = make_bench(4)
    env = bench.make_env()
    learner = bench.make_learner(env)
    seen = []
    act = learner.act
    learner.act = lambda td: (seen.append(td.select(*keys.STATE).clone()), act(td))[1]
    collect(env, learner, 15)
    batch = learner.sample()[0]
    assert batch.batch_size == (32,)
    shown = [assemble(learner.rows.transforms, s) for s in seen]
    known = torch.cat([s[keys.OBSERVATION] for s in shown])
    gap = torch.cdist(batch[keys.OBSERVATION], known).min(-1).values
    # half precision of the rows is all that lies between
    assert gap.max() < 0.25
    spread = torch.cdist(known, known).fill_diagonal_(1e9).min(-1).values
    assert gap.median() < 0.1 * spread.median()
    mask = batch[keys.GROUP_MASK]
    assert mask.shape == (32, 2)
    assert (mask.any(-1)).all()
    for side in keys.SIDES:
        assert batch[side, keys.ACTION].shape == (32, 18)
        assert batch["next", side, keys.REWARD].shape == (32, 1)
    assert batch[keys.STEPS].max() <= 3


def test_unified_rewards_are_the_sum(make_bench, collect):
    bench = make_bench(4, algo={"groups": "unified"})
    env = bench.make_env()
    learner = bench.make_learner(env)
    collect(env, learner, 12)
    learner.generator.manual_seed(0)
    row = learner.buffer.sample(32)
    learner.generator.manual_seed(0)
    batch = learner.sample()[0]
    expected = row["reward"].sum(-1, keepdim=True)
    torch.testing.assert_close(batch["next", "both", keys.REWARD], expected)
    assert batch["both", keys.ACTION].shape == (32, 36)


def test_attempt_worlds_act_deterministically(make_bench, collect):
    bench = make_bench(8, attempt_share=0.5)
    env = bench.make_env()
    learner = bench.make_learner(env)
    td = env.reset()
    for warm in (False, True):
        if warm:
            td = collect(env, learner, 20, td)
            assert learner.ready
        one, two, quiet = (
            learner.act(td),
            learner.act(td),
            learner.act(td, explore=False),
        )
        assert torch.equal(one[:4], two[:4])
        assert torch.equal(one[:4], quiet[:4])
        assert not torch.equal(one[4:], quiet[4:])
        assert one.abs().max() <= 1
        assert one.shape == (8, 2, 18)


def test_warm_up_is_uniform_until_the_buffer_is_ready(make_bench):
    bench = make_bench(64, attempt_share=0.0)
    env = bench.make_env()
    learner = bench.make_learner(env)
    action = torch.cat([learner.act(env.reset()).flatten() for _ in range(3)])
    assert action.mean().abs() < 0.03
    assert action.std().item() == pytest.approx(3**-0.5, rel=0.02)


def through_a_file(state, folder):
    path = save_checkpoint(folder, {"env_steps": 7, "learner": state}, keep=1)
    assert path.name == "000000000007.pt"
    return load_checkpoint(folder)["learner"]


@pytest.mark.parametrize("groups", GROUPS)
def test_state_dict_continues_bit_for_bit(make_bench, collect, tmp_path, groups):
    bench = make_bench(6, algo={"groups": groups})
    env = bench.make_env()
    one = bench.make_learner(env)
    td = collect(env, one, 20)
    for _ in range(3):
        one.update()
    batch = one.sample()[0]  # draws from the generator that goes along
    two = bench.make_learner(env)
    two.load_state_dict(through_a_file(one.state_dict(), tmp_path))
    a, b = one.agent.update(batch.clone()), two.agent.update(batch.clone())
    assert all(torch.equal(a[k], b[k]) for k in a.keys(True, True))
    ours, theirs = parameters(one), parameters(two)
    assert all(torch.equal(ours[k], theirs[k]) for k in ours)
    two.buffer = one.buffer
    assert torch.equal(one.act(td), two.act(td))  # the noise clock went along


def test_a_buffer_that_wraps_keeps_learning(make_bench, collect):
    bench = make_bench(8, algo={"buffer_size": 100})
    env = bench.make_env()
    learner = bench.make_learner(env)
    collect(env, learner, 25)
    assert len(learner.buffer) == 100
    metrics = learner.update()
    assert all(torch.isfinite(v).all() for v in metrics.values(True, True))
