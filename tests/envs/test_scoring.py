"""The compiled judging of a step against the plain one."""

from __future__ import annotations

import pytest
import torch

from flashdex import keys


def object_sum(env):
    """The running sum that one termination keeps."""
    _, early_reset = env.terms.terminations["early_reset"]
    return early_reset.object_sum


@pytest.fixture(scope="module")
def pairs(make_env):
    """Outcomes of random steps, plain and from one graph."""
    envs = [make_env(5, seed=1) for _ in range(2)]
    env = envs[1]
    # Without a break in the graph; inductor itself takes minutes on a CPU.
    env._score = torch.compile(env.terms.__call__, fullgraph=True, backend="aot_eager")
    generator = torch.Generator().manual_seed(0)
    states = [e.reset() for e in envs]
    found = []
    for _ in range(12):
        action = 2 * torch.rand(5, 2, 18, generator=generator) - 1
        steps = []
        for i, e in enumerate(envs):
            e.put_action(states[i], action)
            after = e.step(states[i])["next"]
            steps.append((e.last_step, after))
            states[i] = e.reset_worlds(after[keys.DONE].squeeze(-1))
        found.append((*steps, [object_sum(e).clone() for e in envs]))
    return found


def test_one_graph_gives_the_same_outcome(pairs):
    for (plain, _), (compiled, _), _ in pairs:
        assert torch.equal(plain.reward, compiled.reward)
        assert torch.equal(plain.failed, compiled.failed)
        for name, value in plain.reward_terms.items():
            assert torch.equal(value, compiled.reward_terms[name]), name


def test_running_sums_and_contacts_go_on_from_step_to_step(pairs):
    assert any(after[keys.CONTACT].any() for (_, after), _, _ in pairs)
    for (_, one), (_, other), sums in pairs:
        assert sums[0].any()
        assert torch.equal(*sums)
        assert torch.equal(one[keys.CONTACT], other[keys.CONTACT])
        assert torch.equal(one[keys.DONE], other[keys.DONE])
